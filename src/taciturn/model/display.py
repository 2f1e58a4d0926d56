"""Descriptions of plants, costs, networks and matrices for ``taciturn show``, Python and notebooks."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array
from taciturn._modes import eigenvalues, mode_text
from taciturn._text import Lines, percent
from taciturn.model.cost import Cost
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant, Prediction
from taciturn.model.trigger import Matrix, Scheduled

BLUR = 1e-6  # relative difference below which poles are considered equal
WIDEST = 12  # largest number of columns of a matrix that is printed in full
NamedRows = dict[str, str | Array | None]


def plant_size(plant: Plant | ContinuousPlant, prediction: Prediction | None = None) -> str:
    """Return the numbers of states, inputs and outputs of a plant as text.

    Args:
        plant: the plant.
        prediction: the model of an actuator that predicts, whose state then replaces the input of the sampled plant.
    """
    inputs = plant.inputs if prediction is None else len(prediction.L)
    sizes = ((plant.states, "state"), (inputs, "input"), (plant.C.shape[0], "output"))
    return ", ".join(f"{count} {name}{'s' * (count != 1)}" for count, name in sizes)


def plant_rows(plant: Plant | ContinuousPlant) -> NamedRows:
    """Return the size, time base, poles, measurement, noise and matrices of a plant by name."""
    if isinstance(plant, ContinuousPlant):
        time, jumps = "continuous in time", plant.jumps
    else:
        time = "discrete in time" + ("" if plant.dt is None else f", {plant.dt:g} s per step")
        time, jumps = time + ("" if plant.function is None else ", not linear"), None
    return {
        "size": plant_size(plant),
        "time": time,
        "poles": _poles(plant.A, isinstance(plant, ContinuousPlant)),
        "measured": "the full state, exactly" if plant.full_state else "y = C x + v",
        "noise": None
        if jumps is None
        else f"{jumps.rate:g} jumps per second, {jumps.distribution}, W is rate times covariance",
        "A": plant.A,
        "B": plant.B,
        "C": None if plant.full_state else plant.C,
        "W": plant.W,
        "V": None if plant.full_state else plant.V,
        "mean": plant.mean if plant.mean.any() else None,
        "covariance": plant.covariance if plant.covariance.any() else None,
        "input limit": plant.input_limit,
    }


def _poles(A: Array, continuous: bool) -> str:
    """Return the stability of a plant without control, and its poles, as text."""
    poles = eigenvalues(A)
    size = max(float(np.abs(poles).max()), 1e-300) if continuous else 1.0
    margin = float(poles.real.max() if continuous else np.abs(poles).max() - 1) / size
    stable = "marginally stable" if abs(margin) < BLUR else "stable" if margin < 0 else "unstable"
    shown = (complex(p.real) if abs(p.imag) < BLUR * abs(p) else complex(p) for p in poles)
    return f"{stable}: {', '.join(map(mode_text, shown))}"


def cost_text(cost: Cost) -> str:
    """Return the type of a cost as text: an average, a total or a discounted sum of the quadratic form."""
    kind = "an average"
    if cost.horizon is not None:
        kind = f"a finite-horizon run of {cost.horizon} steps"
    elif cost.discount < 1:
        kind = f"a discounted sum, factor {cost.discount:g} per step"
    cross = " + 2x'Nu" if cost.N.any() else ""
    return f"{kind} of x'Qx + u'Ru{cross}"


def cost_rows(cost: Cost) -> NamedRows:
    """Return the type and the weights of a cost by name."""
    N = cost.N if cost.N.any() else None
    return {"kind": cost_text(cost), "Q": cost.Q, "R": cost.R, "N": N, "terminal": cost.terminal}


def network_text(network: Network) -> str:
    """Return the protocol, losses, delay and encoding of a network in one line of text."""
    if network.protocol == "ideal":
        text = "ideal: every packet arrives"
    else:
        told = "acknowledged" if network.protocol == "tcp" else "no acknowledgement"
        losses = [
            f"{link} drops {percent(network.loss(link))}{' in bursts' if network.burst(link) else ''}"
            for link in ("actuator", "sensor")
        ]
        text = f"{network.protocol} ({told}); {', '.join(losses)}"
    if network.delay:
        text += f"; {network.delay} step{'s' * (network.delay > 1)} of delay"
    return text + (f"; numbers as {network.payload}" if network.payload != "float64" else "")


def matrix_lines(name: str, value: Matrix) -> Lines:
    """Return a matrix row by row; special matrices are abbreviated, and only the first matrix of a table is shown."""
    if isinstance(value, Scheduled):
        first = value.values[0]
        if len(value.values) == 1:
            return matrix_lines(name, first)
        note = (name, f"selected by {value.by}, {len(value.values)} matrices; the first:")
        return [note, *(("", text) for _, text in matrix_lines("", first))]
    rows, columns = value.shape
    diagonal = np.diag(value) if rows == columns else value[:0, 0]
    if not value.any():
        return [(name, f"0 ({rows}×{columns})")]
    if rows == columns > 1 and np.array_equal(value, np.diag(diagonal)):
        same = (diagonal == diagonal[0]).all()
        factor = "" if diagonal[0] == 1 else f"{diagonal[0]:.6g} "
        return [(name, f"{factor}I ({rows}×{rows})" if same else f"diag({', '.join(f'{d:.4g}' for d in diagonal)})")]
    if columns > WIDEST:
        return [(name, f"{rows}×{columns}, entries from {value.min():.4g} to {value.max():.4g}")]
    return [(name if i == 0 else "", vector_text(row)) for i, row in enumerate(value)]


def vector_text(values: Array) -> str:
    """Return the entries of a vector in columns of equal width."""
    return f"[{' '.join(f'{value:10.4g}' for value in values)}]" if len(values) > 1 else f"[{values[0]:.6g}]"
