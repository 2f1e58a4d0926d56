"""Features of delays: constant ones and buffers, whole steps and parts of a period, one delay or several in a network.

Random delays without a buffer come with and without acknowledgements, with losses, in bursts, and from files.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from everything.draft import STEP, Draft, Elsewhere, unneeded

Add = Callable[[Draft], None]
DRAWN = [0.7, 0.2, 0.1]  # probabilities of 0, 1 and 2 steps
BURST = {"to_bad": 0.1, "to_good": 0.4, "loss_good": 0.0, "loss_bad": 0.3}
PART = {"seconds": round(0.35 * STEP, 4)}
MORE = {"seconds": round(1.6 * STEP, 4)}
IN_SECONDS = {"seconds": [round(0.1 * STEP, 4), round(0.8 * STEP, 4)], "probability": [0.7, 0.25]}  # the rest is lost

IN_PARTS = {
    "seconds": [round(0.1 * STEP, 4), round(0.8 * STEP, 4), round(1.3 * STEP, 4)],
    "probability": [0.5, 0.3, 0.2],
}


def of_network(link: str, **keys: object) -> Add:
    """State the delay of a link in [network]."""

    def add(draft: Draft) -> None:
        unneeded(draft, "nodes", "links")
        expect_parts(draft, keys)
        draft.table("network").update(
            {key if key == "protocol" else f"{link}_{key}": value for key, value in keys.items()}
        )

    return add


def of_link(link: str, **keys: object) -> Add:
    """State the delay of a link of the usual network in [links]."""

    def add(draft: Draft) -> None:
        unneeded(draft, "nodes", "network")
        draft.table("links").setdefault(link, {}).update(keys)

    return add


def of_nodes(where: str, *laws: Mapping[str, object]) -> Add:
    """State the delays of the links whose names begin so: the laws in turn."""

    def add(draft: Draft) -> None:
        free = [name for name, role in draft.tables.get("nodes", {}).items() if "site" not in role]
        found = [name for name in free if name.startswith(where)]
        if len(found) < len(laws):
            raise Elsewhere
        for i, name in enumerate(found):
            expect_parts(draft, laws[i % len(laws)])
            draft.table("links").setdefault(name, {}).update(laws[i % len(laws)])

    return add


def in_bursts(draft: Draft) -> None:
    """Draw the delays of inputs by the state of a link with bursts of losses."""
    unneeded(draft, "nodes", "links")
    table = draft.table("network")
    if "actuator_loss" in table or "actuator_burst" in table:
        raise Elsewhere
    table |= {"protocol": "tcp", "actuator_burst": BURST, "actuator_delay": {"states": [[0.9, 0.1], [0.2, 0.5, 0.2]]}}


def of_file(form: str) -> Add:
    """Read the delays of inputs from a histogram, or from a trace with packets that are lost."""

    def add(draft: Draft) -> None:
        unneeded(draft, "nodes", "links")
        if not draft.continuous:
            raise Elsewhere
        times = np.round(STEP * draft.rng.choice([0.2, 0.5, 1.3], 40), 4)
        if form == "trace":
            rows = [f"{STEP * k:.6g},{time if k % 9 else ''}" for k, time in enumerate(times.tolist())]
            draft.files["late.csv"] = "\n".join(("sent,delay", *rows, ""))
        else:
            counted = zip(*np.unique(times, return_counts=True), strict=True)
            rows = [f"{1000 * time:.6g},{count / 40:.6g}" for time, count in counted]
            draft.files["late.csv"] = "\n".join(("milliseconds,probability", *rows, ""))
        draft.table("network").update({"protocol": "tcp", "actuator_delay": {form: "late.csv"}})

    return add


def expect_parts(draft: Draft, keys: Mapping[str, object]) -> None:
    """Raise ``Elsewhere`` where steps have no parts."""
    if not draft.continuous and any(isinstance(value, Mapping) for value in keys.values()):
        raise Elsewhere


SAMPLES: Mapping[str, Add] = {
    "late samples": of_network("sensor", delay=2),
    "samples late by a part": of_network("sensor", delay=PART),
    "samples in a buffer": of_network("sensor", delay=DRAWN, buffer=2),
    "samples too late": of_network("sensor", delay=DRAWN, buffer=1),
    "late sensor": of_link("sensor", delay=1),
    "late probes": of_nodes("probe", {"delay": 1}),
    "probes late by a part": of_nodes("probe", {"delay": PART}, {"delay": MORE}),
    "probes of different delays": of_nodes("probe", {"delay": 2}, {"delay": 1}),
    "probes in buffers": of_nodes("probe", {"delay": DRAWN, "buffer": 2}),
    "samples at random times": of_network("sensor", delay=DRAWN),
    "sensor at random times": of_link("sensor", delay=DRAWN),
    "probes at random times": of_nodes("probe", {"delay": DRAWN}),
    "acknowledged probes at random times": of_nodes("probe", {"delay": [0.6, 0.3], "acknowledged": True}),
    "acknowledged samples at random times": of_network("sensor", delay=[0.6, 0.3], protocol="tcp"),
    "probes too late": of_nodes("probe", {"delay": DRAWN, "buffer": 1, "acknowledged": True}),
}
INPUTS: Mapping[str, Add] = {
    "late inputs": of_network("actuator", delay=1),
    "inputs late by a part": of_network("actuator", delay=PART),
    "inputs late by more": of_network("actuator", delay=MORE),
    "inputs in a buffer": of_network("actuator", buffer=2),
    "inputs too late": of_network("actuator", delay=DRAWN, buffer=1),
    "inputs too late by a part": of_network("actuator", delay=IN_SECONDS, buffer={"seconds": round(0.8 * STEP, 4)}),
    "late actuator": of_link("actuator", delay=2),
    "late valves": of_nodes("valve", {"delay": 1}),
    "valves late by a part": of_nodes("valve", {"delay": MORE}, {"delay": PART}),
    "valves of different delays": of_nodes("valve", {"delay": 1}, {"delay": 3}),
    "inputs at random times": of_network("actuator", delay=DRAWN),
    "inputs at random parts": of_network("actuator", delay=IN_PARTS),
    "acknowledged inputs at random times": of_network("actuator", delay=DRAWN, protocol="tcp"),
    "acknowledged inputs at random parts": of_network("actuator", delay=IN_SECONDS, protocol="tcp"),
    "inputs told late": of_network("actuator", delay=DRAWN, protocol="tcp", acknowledgement_delay=1),
    "losses told late": of_network("actuator", loss=0.1, protocol="tcp", acknowledgement_delay=1),
    "acknowledged sets of valves": of_nodes(
        "valve", {"delay": [0.6, 0.3], "acknowledged": True}, {"loss": 0.1, "acknowledged": True}
    ),
    "late sets of valves": of_nodes("valve", {"delay": IN_SECONDS, "acknowledged": True}, {"price": 2.0}),
    "sets of valves told late": of_nodes(
        "valve", {"delay": [0.6, 0.3], "acknowledged": True, "acknowledgement_delay": 1}
    ),
    "inputs late in bursts": in_bursts,
    "inputs by a trace": of_file("trace"),
    "inputs by a histogram": of_file("histogram"),
    "actuator at random times": of_link("actuator", delay=DRAWN),
    "valves at random times": of_nodes("valve", {"delay": DRAWN}),
    "acknowledged valves at random times": of_nodes("valve", {"delay": DRAWN, "acknowledged": True}),
    "valves too late": of_nodes("valve", {"delay": DRAWN, "buffer": 1, "acknowledged": True}),
}
RANDOM_INPUTS = (
    "inputs at random times", "inputs at random parts", "acknowledged inputs at random times",
    "acknowledged inputs at random parts", "inputs late in bursts", "inputs by a trace", "inputs by a histogram",
    "actuator at random times", "inputs told late", "losses told late",
)  # fmt: skip
"""Features of random delays of the only input link, which few kinds accept."""
