"""Answers to the page's requests: each function takes a setting, and caches designs and evaluations.

``Answers`` reads a setting from its text. It keeps the last problems, designs and evaluations, so that the parts of an
answer share them. A result is data for the page. An error of the library becomes a sentence at the caller.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from typing import Any, TypeVar, cast

from taciturn.design.catalogue import CATALOGUE
from taciturn.errors import ProblemError, TaciturnError
from taciturn.extend import check_time, quoted
from taciturn.problem import Problem
from taciturn.study.evaluation import Evaluation
from taciturn_explore import plane
from taciturn_explore.controls import controls_of, offered, suits, tuned, tuning_value, with_kind
from taciturn_explore.curves import anchor
from taciturn_explore.files import Effort, problem_file
from taciturn_explore.network import network
from taciturn_explore.response import response
from taciturn_explore.setting import (
    FEWEST_STEPS,
    MOST_SEED,
    MOST_STEPS,
    Setting,
    Trusted,
    Value,
    checked,
    event_of,
    setting_of,
    whole_number,
)

T = TypeVar("T")
KEPT = 32  # problems, designs and evaluations that are kept
COMPARED = 3  # kinds whose curves are shown if the setting names none
FIRST_COMPARED = ("lqg", "send-on-delta", "self-triggered", "event-pid")  # well-known rules, shown before others


class Answers:
    """Compute the answers to the page's requests, in a worker process."""

    def __init__(self, trusted: Trusted | None = None) -> None:
        """Start with empty caches."""
        self.trusted = trusted
        self.opened = ""  # the text of a setting whose refined answer is that of ``taciturn evaluate``
        self._kept: OrderedDict[Hashable, Any] = OrderedDict()

    def compute(self, name: str, arguments: tuple[Any, ...]) -> Any:
        """Compute the answer to the request with a given name."""
        return getattr(self, name)(*arguments)

    def settle(self, text: str, changes: Mapping[str, Value], parts: Mapping[str, Any]) -> dict[str, Any]:
        """Apply changes to a setting, and return the page's controls and the other data that need no simulation."""
        setting = setting_of(text)
        base = self._base(setting)
        if "kind" in parts:
            setting = with_kind(setting, base, self._lenient(setting, base), str(parts["kind"]))
        setting = _with_parts(setting, parts).to(changes)
        setting = checked(setting).stated(base)
        found: dict[str, Any] = {
            "text": setting.text,
            "name": setting.name or (self.trusted.name if self.trusted is not None else "") or "problem file",
            "seed": setting.seed,
            "steps": setting.steps,
            "events": [one.__dict__ for one in setting.events],
            "compare": None if setting.compare is None else list(setting.compare),
        }
        problem = self._problem(setting)
        kind, main = problem.record, tuned(problem)
        return found | {
            "curve": self._along(setting, problem).text,
            "kind": {"name": kind.name, "goal": kind.goal, "about": kind.about},
            "controls": [one.document() for one in controls_of(setting, problem)],
            "tuning": None
            if main is None
            else {
                "key": f"policy.{main.name}",
                "name": main.name,
                "value": tuning_value(problem, main),
                "whole": main.whole,
                "note": kind.notes.get(main.name, ""),
            },
        }

    def point(self, text: str, refined: bool) -> dict[str, Any]:
        """Compute cost and traffic of a setting, with coarse or refined accuracy, as a point of the page's plot."""
        setting = setting_of(text)
        problem = self._problem(setting)
        effort = plane.COARSE
        found = self._evaluated(setting, effort)
        if not refined and found.cost.standard_error > plane.ROUGH * abs(found.cost.value):
            effort = plane.LESS_COARSE
            found = self._evaluated(setting, effort)
        if refined:
            effort, found = self._refined(setting)
        return plane.point(setting, problem, found, effort)

    def response(self, text: str, rates: list[dict[str, Any]] | None = None) -> dict[str, Any]:
        """Simulate the loop at a setting and with periodic control; ``rates`` are the packet rates of the setting."""
        setting = setting_of(text)
        listed: list[dict[str, Any]] = self.point(text, False)["rates"] if rates is None else rates
        shares = {one["link"]: one["value"] if one["share"] is None else one["share"] for one in listed}
        return response(setting, self._designed(setting), shares)

    def network(self, text: str) -> dict[str, Any]:
        """Compute the links of a setting's network, and the intervals between packets on each link."""
        setting = setting_of(text).averaged
        return network(setting, self._designed(setting))

    def along(self, text: str, kind: str) -> dict[str, Any] | None:
        """Return the parameter of a kind's trade-off curve and its first value; None if the kind has none."""
        setting, base = setting_of(text).averaged, self._base(setting_of(text))
        if kind:
            setting = with_kind(setting, base, self._lenient(setting, base), kind).stated(base)
        problem = self._problem(setting)
        main = tuned(problem)
        if main is None:
            return None
        value = anchor(tuning_value(problem, main), main.whole)
        return {
            "text": self._along(setting, problem).text,
            "key": f"policy.{main.name}",
            "value": value,
            "whole": main.whole,
            "least": main.least,
            "falls": main.falls,
        }

    def curve_point(self, text: str, key: str, value: float) -> dict[str, Any]:
        """Compute the cost and the traffic of one point of a trade-off curve."""
        setting = setting_of(text).averaged.to({key: value})
        problem = self._problem(setting)
        return plane.curve_point(problem, plane.on_curve(setting, problem))

    def fair(self, text: str) -> dict[str, Any]:
        """Compute cost against traffic for fair periodic control."""
        setting = setting_of(text).averaged
        return plane.fair(self._problem(setting), self._evaluated(setting, plane.COARSE))

    def timed(self, text: str, share: float) -> dict[str, Any]:
        """Compute the cost of fair periodic control over several links, at a share of the traffic of every sample."""
        setting = setting_of(text).averaged
        return plane.timed(self._problem(setting), self._evaluated(setting, plane.COARSE), share)

    def beside(self, text: str) -> dict[str, Any]:
        """Compute the cost of periodic control over several links, at the refined traffic of a setting."""
        setting = setting_of(text).averaged
        return plane.beside(self._problem(setting), self._refined(setting)[1])

    def bound(self, text: str) -> dict[str, Any]:
        """Compute a lower bound on the cost of a setting's controller, valid for every schedule of its sends."""
        setting = setting_of(text).averaged
        return plane.bound(setting, self._problem(setting))

    def kinds(self, text: str) -> dict[str, Any]:
        """Return the policy kinds that can run the problem, and those whose curves the page shows for comparison."""
        setting = setting_of(text).averaged
        base, found = self._base(setting), list[str]()
        for name in offered(CATALOGUE):
            check_time()
            if suits(base, setting, name):
                found.append(name)
        own = self._problem(setting).kind
        first = [name for name in (*FIRST_COMPARED, *found) if name in found and name != own]
        return {
            "kinds": [{"name": name, "goal": CATALOGUE[name].goal} for name in found],
            "compare": list(dict.fromkeys(first))[:COMPARED],
        }

    def difference(self, text: str, pinned: str) -> dict[str, Any]:
        """Compute how cost and rates differ between a setting and a pinned setting, with the same random numbers."""
        setting, other = setting_of(text).averaged, setting_of(pinned).averaged
        return plane.differences(self._designed(other), self._designed(setting), setting.seed)

    def file(self, text: str) -> str:
        """Return the text of the problem file for a setting."""
        setting = setting_of(text)
        return problem_file(setting, self._problem(setting))

    def _base(self, setting: Setting) -> Problem:
        return self._keep(("base", setting.name, setting.file), lambda: setting.base(self.trusted))

    def _problem(self, setting: Setting) -> Problem:
        plain = setting.averaged
        return self._keep(("problem", plain), lambda: plain.problem(self._base(setting)))

    def _lenient(self, setting: Setting, base: Problem) -> Problem:
        """Return the problem of a setting, or the base if the changes do not fit."""
        try:
            return self._problem(setting)
        except TaciturnError:
            return base

    def _designed(self, setting: Setting) -> plane.Designed:
        plain = setting.averaged
        return self._keep(("design", plain), lambda: plane.designed(self._problem(setting)))

    def _evaluated(self, setting: Setting, effort: Effort, further: bool = False) -> Evaluation:
        plain = setting.averaged
        key = "evaluation", plain, effort, further
        return self._keep(key, lambda: plane.measured(plain, self._problem(plain), effort, further))

    def _refined(self, setting: Setting) -> tuple[Effort, Evaluation]:
        """Return the refined evaluation of a setting, also on the plant as written if a controller is given."""
        same = setting.text == self.opened
        effort = Effort() if same else plane.fine(self._evaluated(setting, plane.COARSE))
        return effort, self._evaluated(setting, effort, self._problem(setting).controller is not None)

    def _along(self, setting: Setting, problem: Problem) -> Setting:
        """Return the setting without the value of its trade-off parameter, which names the curve it is on."""
        main = tuned(problem)
        return setting.averaged if main is None else setting.averaged.to({f"policy.{main.name}": None})

    def _keep(self, key: Hashable, compute: Callable[[], T]) -> T:
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        found = compute()
        self._kept[key] = found
        if len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return found


def _with_parts(setting: Setting, parts: Mapping[str, Any]) -> Setting:
    """Return a setting with other parts than its changes."""
    for name, given in parts.items():
        value: object = given
        listed = cast("list[object]", value if isinstance(value, list) else [])
        words = [one for one in listed if isinstance(one, str)]
        if name == "seed":
            setting = replace(setting, seed=whole_number(name, str(given), MOST_SEED))
        elif name == "steps":
            setting = replace(setting, steps=whole_number(name, str(given), MOST_STEPS, FEWEST_STEPS))
        elif name == "events" and isinstance(value, list):
            setting = replace(setting, events=tuple(event_of(*_pair(one)) for one in listed))
        elif name == "compare" and isinstance(value, list) and len(words) == len(listed):
            setting = replace(setting, compare=tuple(words))
        elif name != "kind":
            raise ProblemError(
                f"the entry {name!r} of the page's settings is {quoted(given)}; expected a valid value of seed, steps, "
                "events, compare or kind"
            )
    return setting


def _pair(event: object) -> tuple[str, str]:
    pair = [one for one in cast("list[object]", event if isinstance(event, list) else []) if isinstance(one, str)]
    if len(pair) != 2:
        raise ProblemError(
            f"an event of the page's settings is {quoted(cast('Any', event))}; expected a list with the kind and the "
            "text of the event"
        )
    return pair[0], pair[1]
