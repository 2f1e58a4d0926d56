"""Save the page as one HTML file that needs no server: it contains all scripts, styles and data.

It is the record of a run (``recording``), or the answers of precomputed settings.

The settings differ in the trade-off parameter; they are those of the curve (``curves``) and the given one. The page has
the control of this parameter, and shows the nearest setting of the file. It opens with the given setting, whose numbers
are those of ``taciturn evaluate``.
"""

from __future__ import annotations

import json
from html import escape
from pathlib import Path
from typing import Any

from taciturn.errors import ProblemError, TaciturnError
from taciturn.extend import Progress, write_whole
from taciturn_explore.answers import Answers
from taciturn_explore.bundle import bundle, styles, variable
from taciturn_explore.curves import values_of_curve
from taciturn_explore.recording import Recording
from taciturn_explore.setting import Setting, Trusted

_CURVE, _SETTINGS = 0.1, 0.8  # shares of the progress, nearly those of the time


def save_page(setting: Setting, trusted: Trusted | None, path: Path, progress: Progress | None = None) -> int:
    """Save a page with the answers for all settings on a trade-off curve, and return how many settings these are.

    Raises:
        ProblemError: the problem has no trade-off parameter, or a design refuses it.
    """
    answers = Answers(trusted)
    found = precomputed(answers, setting, progress)
    name = found["settings"][0]["answers"][0]["name"]
    _write(path, name, bundle("precomputed"), f"{variable('precomputed')}.open", found)
    return len(found["settings"])


def save_recording(found: Recording, path: Path) -> None:
    """Save a page that shows a recorded run."""
    _write(path, found.name, bundle("recording"), f"{variable('recording')}.mount", found.document())


def _write(path: Path, name: str, script: str, opened: str, shown: object) -> None:
    """Write a page whose script opens it with what it shows."""
    data = json.dumps(shown, separators=(",", ":")).replace("<", "\\u003c")
    script += f"{opened}(document.getElementById('explore'), {data});\n"
    page = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{escape(name)} · taciturn explore</title>\n<style>\n{styles()}</style>\n</head>\n<body>\n"
        f'<div id="explore"></div>\n<script type="module">\n{script}</script>\n</body>\n</html>\n'
    )
    write_whole(path, page.encode())


def precomputed(answers: Answers, setting: Setting, progress: Progress | None) -> dict[str, Any]:
    """Compute the answers for all settings on the trade-off curve through a setting, and the answers common to them."""
    begun = answers.settle(setting.text, {}, {})
    text, on = begun["text"], begun["curve"]
    curve = _curve(answers, text, "", progress, _CURVE)
    if curve is None:
        raise ProblemError(
            f"the policy kind {begun['kind']['name']} has no trade-off parameter, so there is no curve to save; "
            "expected a kind with such a parameter"
        )
    given, fair = begun["tuning"]["value"], answers.fair(text)
    answers.opened = answers.settle(text, {curve["key"]: given}, {})["text"]
    values = sorted({given, *(one["parameter"] for one in curve["points"])})
    settings = list[dict[str, Any]]()
    for i, value in enumerate(values):
        settled = answers.settle(text, {curve["key"]: value}, {})
        settled["controls"] = [one for one in settled["controls"] if one["tuning"]]
        own = settled["text"]
        found = [
            ("setting", settled),
            ("point", {"refined": True, **answers.point(own, True)}),
            ("response", answers.response(own)),
            ("network", answers.network(own)),
            *([("beside", _beside(answers, own))] if fair["shares"] else []),
        ]
        listed = [{"answer": name, "setting": own, **one} for name, one in found]
        settings.append({"value": value, "answers": listed, "file": answers.file(own)})
        if progress is not None:
            progress(_CURVE + _SETTINGS * (i + 1) / len(values))
    shared: list[dict[str, Any]] = [{"answer": "curve", "on": on, "own": True, **curve}]
    points = list[dict[str, Any]]()
    for share in fair["shares"]:
        try:
            points.append(answers.timed(text, share))
        except TaciturnError:
            break
    shared.append(
        {"answer": "fair", "on": on, "points": fair["points"] or sorted(points, key=lambda one: one["traffic"])}
    )
    kinds = answers.kinds(text)
    listed = setting.compare if setting.compare is not None else kinds["compare"]
    chosen = [kind for kind in listed if kind != begun["kind"]["name"]]
    named = [one for one in kinds["kinds"] if one["name"] in chosen]
    shared.append({"answer": "kinds", "on": on, "kinds": named, "compare": chosen})
    for kind in chosen:
        other = _curve(answers, text, kind, None, 0.0)
        shared += [] if other is None else [{"answer": "curve", "on": on, "own": False, **other}]
    if progress is not None:
        progress(1.0)
    first = next(i for i, one in enumerate(settings) if one["value"] == given)
    return {"settings": settings, "shared": shared, "first": first, "key": curve["key"]}


def _beside(answers: Answers, text: str) -> dict[str, Any]:
    """Return periodic control over several links at the traffic of a setting, or the reason why there is none."""
    try:
        return answers.beside(text)
    except TaciturnError as error:
        return {"reason": str(error)}


def _curve(answers: Answers, text: str, kind: str, progress: Progress | None, share: float) -> dict[str, Any] | None:
    """Return a whole curve, or None if there is none."""
    try:
        along = answers.along(text, kind)
    except TaciturnError:
        return None
    if along is None:
        return None
    points, values, told = list[dict[str, Any]](), values_of_curve(along), None
    while True:
        try:
            value = values.send(told)
        except StopIteration:
            break
        try:
            found = answers.curve_point(along["text"], along["key"], value)
            told = found if found["share"] is not None else None
        except TaciturnError:
            told = None
        points += [] if told is None else [told]
        if progress is not None:
            progress(share * min(1.0, len(points) / 30))
    return {"kind": kind, "key": along["key"], "points": sorted(points, key=lambda one: one["traffic"]), "whole": True}
