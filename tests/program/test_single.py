"""Single precision: the draws are those of double precision to seven digits, and so is what they lead to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from program.test_draws import telling_words

import taciturn
from taciturn import Cost, Plant
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.program.draws import draw_numbers
from taciturn.program.ir import Builder
from taciturn.program.numpy import run
from taciturn.program.ops import Entry, Name, Precision
from taciturn.simulation.average import choose_estimator, plain_average
from taciturn.simulation.sampling import Part, Sampling

KINDS: tuple[Precision, Precision] = ("float64", "float32")
RESOLUTION = 2.0**-24  # of a float near 1


def drawn(words: np.ndarray, precision: Precision, *names: Entry) -> list[np.ndarray]:
    """Return what is drawn from given words: with s0 = 0 the output of the generator is the rotated s3."""
    states = np.zeros((4, len(words)), dtype=np.uint64)
    states[3] = (words >> np.uint64(23)) | (words << np.uint64(41))
    b, supplied = Builder(precision), dict[Name, int]()
    following = draw_numbers(b, names, supplied)
    outputs = run(b.finish(following, {}, supplied), states.view(np.float64), 1).outputs
    return [outputs[name][0] for name in names]


@pytest.mark.evidence
def test_the_normals_of_a_word_are_those_of_double_precision() -> None:
    """At random words and at the edges of every field: the logarithm to 3e-7 of 1, all else to a few roundings."""
    words = telling_words()
    double, single = (
        np.array(drawn(words, kind, Entry("normal", 0), Entry("normal", 1))) for kind in ("float64", "float32")
    )
    radius = np.hypot(*double)
    slack = 4e-7 / np.maximum(radius, 0.05) + 10 * RESOLUTION * radius
    assert (np.abs(single - double) <= slack)[:, radius > 0.05].all()
    assert np.hypot(*single)[radius <= 0.05].max() < 0.051
    assert not (single == double).all(axis=1).any(), "single precision was not used"


def test_a_uniform_lies_strictly_between_zero_and_one() -> None:
    """It is that of double precision without the last bits."""
    words = np.concatenate([telling_words(), np.array([0, 2**64 - 1], dtype=np.uint64)])
    (double,), (single,) = (drawn(words, kind, Entry("uniform", 0)) for kind in ("float64", "float32"))
    assert list(single[-2:]) == [RESOLUTION, 1 - RESOLUTION]
    assert np.abs(single - double).max() <= RESOLUTION


def masses(precision: Precision = "float64") -> Loop:
    """Return the loop of the two masses."""
    problem = taciturn.load("two-mass-lqg")
    return replace(problem.close(problem.design()), precision=precision)


@pytest.mark.evidence
def test_the_bias_is_below_a_millionth_of_the_cost() -> None:
    """Paths of both precisions share their draws, so the difference is known to 1e-7, in both forms of the loop."""
    for estimator in (choose_estimator, plain_average):
        parts = [Part(loop, estimator(loop), sign) for loop, sign in ((masses("float32"), 1.0), (masses(), -1.0))]
        *_, found = Sampling(parts, 0, None, None).stationary(None, 100_000_000)
        assert 0 < found.cost.standard_error < 2e-7
        assert abs(found.cost.value) + 2 * found.cost.standard_error < 1e-6
        rate = found.rates["actuator"]
        assert abs(rate.value) < 1e-6 + 3 * rate.standard_error


def test_evaluations_in_single_precision_agree() -> None:
    """To six digits, on the same seed."""
    problem = taciturn.load("two-mass-lqg")
    single, double = (taciturn.evaluate(problem, precision=kind, steps=10**7) for kind in ("float32", "float64"))
    assert single.cost.value == pytest.approx(double.cost.value, rel=1e-6)
    assert single.cost.value != double.cost.value


def test_the_standard_error_allows_for_rounding() -> None:
    """A millionth of what is simulated, where the draws leave less."""
    plant, cost = Plant([[0.5]], [[1.0]], [[1e-12]], mean=[1e3]), Cost([[1.0]], [[1.0]])
    policy = taciturn.design.all_time(plant, cost)
    loop = taciturn.close(plant, policy, cost=Cost([[1.0]], [[1.0]], horizon=20))
    double, single = (taciturn.average(replace(loop, precision=kind), steps=20_000).cost for kind in KINDS)
    assert double.standard_error < 1e-8 * double.value
    assert single.standard_error == pytest.approx(1e-6 * single.value, rel=1e-3)
    assert abs(single.value - double.value) < single.standard_error


@pytest.mark.parametrize("scale", [1e-40, 1e-60, 1e37])
def test_costs_beyond_the_range_of_single_precision_are_refused(scale: float) -> None:
    """Instead of sums of zeros, or of infinities."""
    plant, cost = Plant([[1.2]], [[1.0]], [[scale]]), Cost([[1.0]], [[1.0]])
    loop = taciturn.close(plant, taciturn.design.lqg(plant, cost, theta=0.2))
    assert taciturn.average(loop, steps=100_000).rates["actuator"].value > 0.01
    with pytest.raises(
        ProblemError,
        match=r"precision is 'float32', but the cost of a step is about .*outside the range of this format",
    ):
        replace(loop, precision="float32")


def test_what_single_precision_cannot_do_is_refused() -> None:
    """Another name, and weights that multiply up their rounding errors."""
    with pytest.raises(ProblemError, match="precision is 'half'; expected 'float64' or 'float32'"):
        replace(masses(), precision="half")
    plant, average = Plant([[1.2]], [[1.0]], [[0.1]]), Cost([[1.0]], [[1.0]])
    policy = taciturn.design.all_time(plant, average)
    loop = taciturn.close(plant, policy, cost=Cost([[1.0]], [[1.0]], discount=0.9))
    with pytest.raises(ProblemError, match=r"with the discount 0\.9, rounding errors accumulate"):
        replace(loop, precision="float32")
