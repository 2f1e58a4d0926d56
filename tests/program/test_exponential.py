"""Exponentials made of the program's own operations, and what they are for: triggers with a bell."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from parity.loops import same

from taciturn import ProblemError
from taciturn.model.trigger import Form, GaussianTerm
from taciturn.program.functions import falling
from taciturn.program.ir import Builder, Program
from taciturn.program.machine import Kernel
from taciturn.program.numpy import run
from taciturn.program.translation import TimeStep


def exponential(precision: Literal["float64", "float32"]) -> Program:
    """Return the program that turns its input x into e^{−x}."""
    builder = Builder(precision)
    return builder.finish([], {}, {"found": falling(builder, builder.input("x"))})


@pytest.mark.parametrize(("precision", "far", "digits"), [("float64", 700.0, 4e-16), ("float32", 80.0, 2.5e-7)])
def test_an_exponential_has_all_digits_of_its_precision(
    precision: Literal["float64", "float32"], far: float, digits: float
) -> None:
    """From 0 to where nothing is left, and at the places where 2^k changes; beyond them it stays where it ends."""
    steps = np.log(2) * (np.arange(int(far / np.log(2))) + 0.5)
    x = np.concatenate([np.linspace(0, far, 20_001), steps * (1 - 1e-7), steps * (1 + 1e-7), [1e-300, 1e-9]])
    if precision == "float32":
        x = x.astype(np.float32).astype(np.float64)
    program = exponential(precision)
    for found in (run(program, np.zeros((0, len(x))), 1, x[None, None]), Kernel(program).run(
        program, np.zeros((0, len(x))), 1, x[None, None]
    )):  # fmt: skip
        assert np.abs(found.outputs["found"][0] / np.exp(-x) - 1).max() <= digits
    ends = np.array([-3.0, 2 * far])
    found = run(program, np.zeros((0, 2)), 1, ends[None, None]).outputs["found"][0]
    assert found == pytest.approx([1.0, np.exp(-far)], rel=digits)


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_an_exponential_has_the_same_bits_in_numpy_and_in_machine_code(
    precision: Literal["float64", "float32"],
) -> None:
    """The bit-exact build, at random places of every size."""
    x = np.exp(np.random.default_rng(1).uniform(-40, 8, 999))[None, None]
    program = exponential(precision)
    meaning = run(program, np.zeros((0, x.shape[2])), 1, x).outputs["found"]
    assert same(meaning, Kernel(program, "parity").run(program, np.zeros((0, x.shape[2])), 1, x).outputs["found"])


def test_a_form_adds_its_bell_to_its_quadratic() -> None:
    """η'Ψη + h exp(−½η'Πη) + weight·s + constant."""
    rng = np.random.default_rng(3)
    Psi, Pi, eta, s = np.diag([1.0, -2.0]), np.array([[2.0, 0.5], [0.5, 1.0]]), rng.normal(size=(2, 7)), rng.random(7)
    form = Form(("eta",), Psi, 0.25, {"s": 3.0}, GaussianTerm(-1.5, Pi))
    builder = Builder()
    tick = TimeStep(builder, {"eta": 2, "s": 1}, {"eta": "eta", "s": "s"}, ())
    program = tick.finish({}, {"found": tick.form(form)})
    starts = {("eta", 0): eta[0], ("eta", 1): eta[1], ("s", 0): s}
    states = np.array([starts[state.name, state.index] for state in program.states])
    found = run(program, states, 1).outputs["found"][0]
    quadratic = [np.einsum("ik,ij,jk->k", eta, weight, eta) for weight in (Psi, Pi)]
    assert found == pytest.approx(quadratic[0] - 1.5 * np.exp(-0.5 * quadratic[1]) + 3 * s + 0.25, rel=1e-14)


def test_what_is_no_bell_is_refused() -> None:
    """An indefinite Π, one that is not square, or a bell over nothing."""
    with pytest.raises(ProblemError, match="Pi has the eigenvalue -1; expected a positive semidefinite matrix"):
        GaussianTerm(1.0, np.diag([1.0, -1.0]))
    with pytest.raises(ProblemError, match="Pi has shape"):
        GaussianTerm(1.0, [[1.0, 0.0]])
    with pytest.raises(
        ProblemError,
        match=r"a quadratic form has a Gaussian term \(bell\) without signals; expected signals as well",
    ):
        Form(bell=GaussianTerm(1.0, [[1.0]]))
