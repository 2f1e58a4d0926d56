"""Read a recorded twin run from the file of ``taciturn twin --record``: the first run under each policy.

The path with every sample is that of the same robot without the faults. Estimates and poses have the same axes, so the
pose is shown, and what the camera has seen is left out. A file is read in memory, and the size that it states for a
variable is checked before the variable is read.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping
from typing import Any, cast

import numpy as np

from taciturn.errors import ProblemError
from taciturn_explore.recorded_runs import faults_of_twin, verdict_of_twin
from taciturn_explore.recording import LONGEST, Fault, Lane, Recording, Trace

HDF5 = b"\x89HDF\r\n\x1a\n"  # the first bytes of a file
NUMBERS = 20_000_000  # of a variable
USED = ("pose", "given", "trigger", "sent", "arrived", "time")
NAMED = ("policy", "state", "input", "link")
SIDES = {"sensor": ("camera", "controller"), "actuator": ("controller", "robot")}


def of_twin(name: str, content: bytes) -> Recording:
    """Read a recorded twin run from its NetCDF file.

    Raises:
        ProblemError: the file is not one of a twin.
    """
    try:
        found = _read(content)
    except (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError, RecursionError) as error:
        raise ProblemError(
            f"{name} is not the record of a twin ({str(error)[:120]}); expected a file that `taciturn twin ROBOT "
            "--record OUT.nc` wrote"
        ) from None
    document = cast("Mapping[str, Any]", found["document"])
    time, sent, arrived, trigger = found["time"], found["sent"], found["arrived"], found["trigger"]
    steps, period = sent.shape[-1], float(time[1] - time[0])
    always = sent.shape[0] > 1
    traces = [
        Trace(f"{state}", found["pose"][0, 0, :steps, k], found["pose"][1, 0, :steps, k] if always else None)
        for k, state in enumerate(found["state"])
    ]
    traces += [
        Trace(f"{one}", found["given"][0, 0, :, k], found["given"][1, 0, :, k] if always else None, held=True)
        for k, one in enumerate(found["input"])
    ]
    lanes = list[Lane]()
    for k, link in enumerate(found["link"]):
        here, there = sent[0, k, 0] > 0, arrived[0, k, 0] > 0
        other = sent[1, k, 0] > 0 if always else None
        own = trigger[0, 0, :, 0] - trigger[0, 0, :, 1] if link == "actuator" else None
        sender, receiver = SIDES.get(link, ("?", "?"))
        lanes.append(Lane(link, sender, receiver, here, here & ~there, other, own, ratio=False))
    faults = list(_faults(document, period, steps))
    compared = ("event-triggered", "every sample, without faults") if always else None
    notes = [str(one)[:LONGEST] for one in document.get("notes", ())][:20]
    return Recording(
        name, verdict_of_twin(document, faults), 0, steps, period, traces, lanes, faults, compared, notes=notes
    )


def _read(content: bytes) -> dict[str, Any]:
    """Return the variables and the document of a file, with checked shapes."""
    import h5py

    found = dict[str, Any]()
    opened: Any = h5py.File  # its types are incomplete
    with opened(io.BytesIO(content), "r") as file:
        for one in USED:
            given: Any = file[one]
            if given.size is None or given.size > NUMBERS:
                raise ValueError(f"the variable {one!r} is empty, or has more than {NUMBERS:,} numbers")
            found[one] = np.asarray(given[()], dtype=np.float64)
        for one in NAMED:
            texts: Any = file[one]
            if texts.size is None or texts.size > 64:
                raise ValueError(f"the variable {one!r} is empty, or has more than 64 names")
            found[one] = [str(text)[:60] for text in texts.asstr()[()]]
        document: Any = file.attrs["document"]
    read: Any = json.loads(document if isinstance(document, str) else bytes(document).decode())
    if not isinstance(read, dict) or not isinstance(cast("dict[str, Any]", read).get("robot"), str):
        raise ValueError("its document names no robot")
    found["document"] = read
    _check_shapes(found)
    return found


def _check_shapes(found: Mapping[str, Any]) -> None:
    policies, links, runs, steps = cast("tuple[int, int, int, int]", found["sent"].shape)
    states, inputs = len(found["state"]), len(found["input"])
    expected = {
        "pose": (policies, runs, steps + 1, states),
        "given": (policies, runs, steps, inputs),
        "trigger": (policies, runs, steps, 2),
        "arrived": (policies, links, runs, steps),
        "time": (steps + 1,),
    }
    wrong = [one for one, shape in expected.items() if found[one].shape != shape]
    if wrong or links != len(found["link"]) or not (1 <= policies <= 2 and runs >= 1 and steps >= 1):
        raise ValueError(f"the shape of {', '.join(wrong) or 'sent'} differs from that in the record of a twin")
    period = found["time"][1] - found["time"][0]
    if not 0 < period < 1e6:
        raise ValueError(f"its steps last {period} s")


def _faults(document: Mapping[str, Any], period: float, steps: int) -> Iterator[Fault]:
    for one in faults_of_twin(document):
        first = min(steps - 1, round(one.start / period))
        last = steps if one.name == "gain" else round((one.start + one.lasts) / period)
        end = min(steps, max(first + 1, last))
        yield Fault(one.title, one.told, first, end, "actuator" if one.name == "actuator" else "")
