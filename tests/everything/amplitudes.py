"""Features of the signals of a plant: their names and units, which change no number, and noise by its amplitude."""

from __future__ import annotations

from collections.abc import Callable

from everything.draft import Draft, Elsewhere, need, rows


def names(draft: Draft) -> None:
    """Name the inputs, in the older table."""
    draft.tables["names"] = {"inputs": [f"force {i} (N)" for i in range(len(draft.plant["B"][0]))]}


def named_signals(draft: Draft) -> None:
    """Name all signals of the plant, with units of some."""
    draft.plant["state_names"] = [f"state-{i}" for i in range(draft.states)]
    draft.plant["input_names"] = [f"force {i}" for i in range(draft.inputs)]
    draft.plant["output_names"] = [f"level {i}" for i in range(draft.outputs)]
    draft.plant["units"] = {"states": ["m"] * draft.states, "inputs": ["N"] * draft.inputs}


def noise_at(*places: str) -> Callable[[Draft], None]:
    """State the noise at the inputs, or at the outputs, by amplitude."""

    def add(draft: Draft) -> None:
        need(draft, *("W" if place == "input" else "V" for place in places))
        sizes = {"input": draft.inputs, "output": draft.outputs}
        for plant in (draft.plant, draft.plant["actual"]) if "actual" in draft.plant else (draft.plant,):
            for place in places:
                plant.pop("W" if place == "input" else "V", None)
                noise = plant.setdefault("noise", {})
                noise[place] = rows(draft.rng.uniform(0.2, 0.5, sizes[place]))
            if "W" not in plant and "input" not in plant["noise"] and "jumps" not in plant:
                raise Elsewhere

    return add
