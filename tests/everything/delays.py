"""Features of constant delays and of buffers: whole steps and parts of a period, one delay or several in a network."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from everything.draft import STEP, Draft, Elsewhere, unneeded

Add = Callable[[Draft], None]
DRAWN = [0.7, 0.2, 0.1]  # probabilities of 0, 1 and 2 steps
PART = {"seconds": round(0.35 * STEP, 4)}
MORE = {"seconds": round(1.6 * STEP, 4)}
IN_SECONDS = {"seconds": [round(0.1 * STEP, 4), round(0.8 * STEP, 4)], "probability": [0.7, 0.25]}  # the rest is lost


def of_network(link: str, **keys: object) -> Add:
    """State the delay of a link in [network]."""

    def add(draft: Draft) -> None:
        unneeded(draft, "nodes", "links")
        expect_parts(draft, keys)
        draft.table("network").update({f"{link}_{key}": value for key, value in keys.items()})

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
    "valves too late": of_nodes("valve", {"delay": DRAWN, "buffer": 1, "acknowledged": True}),
}
