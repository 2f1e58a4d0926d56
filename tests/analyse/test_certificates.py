"""Certificates against what is known exactly, against rational arithmetic, and refused where there is none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from catalogue import POLICIES, closed
from counts import few
from systems import make_system

import taciturn
from taciturn import Cost, Plant, ProblemError, close, design
from taciturn._modes import radius
from taciturn.analyse.switched import Switched, switched, switched_innovations
from taciturn_certify.certificates import (
    Certificate,
    NoCertificateError,
    bound_cost,
    bound_state,
    find_decay,
    find_gain,
)
from taciturn_certify.inequalities import Inequalities, Inequality, Unknowns

HALVING = 2.0**-12  # what the search for a rate leaves open


def two_masses(theta: float = 0.1) -> Switched:
    """Return the loop of the two masses on a spring, held inputs."""
    problem = taciturn.load("two-mass-lqg").changed({"theta": theta})
    return switched(problem.close(problem.design()))


def peak(loop: Switched) -> float:
    """Return the largest gain over frequencies of a linear loop, from its frequency response."""
    values, vectors = np.linalg.eigh(loop.M[0])
    output = (vectors * np.sqrt(np.maximum(values, 0.0))).T
    circle = np.exp(1j * np.linspace(0.0, np.pi, 20_001))[:, None, None] * np.eye(loop.states)
    return float(np.linalg.norm(output @ np.linalg.solve(circle - loop.F[0], loop.G), 2, axis=(1, 2)).max())


def rational(matrix: np.ndarray) -> list[list[Fraction]]:
    """Return the entries as the rational numbers that they are."""
    return [[Fraction(float(entry)) for entry in row] for row in matrix]


def times(one: list[list[Fraction]], other: list[list[Fraction]]) -> list[list[Fraction]]:
    """Return the product without rounding."""
    columns = list(zip(*other, strict=True))
    return [[sum((a * b for a, b in zip(row, column, strict=True)), Fraction(0)) for column in columns] for row in one]


def left_side(one: Inequality, solution: Unknowns) -> list[list[Fraction]]:
    """Return the left side of an inequality without rounding."""
    total = rational(one.constant)
    terms = [(Fraction(float(solution.scalars[j])), rational(S)) for j, S in one.scalars]
    for weight, k, T in one.squares:
        exact = rational(T)
        turned = [list(row) for row in zip(*exact, strict=True)]
        terms.append((Fraction(weight), times(times(turned, rational(solution.matrices[k])), exact)))
    for weight, matrix in terms:
        total = [[a + weight * b for a, b in zip(*rows, strict=True)] for rows in zip(total, matrix, strict=True)]
    return total


def is_semidefinite(matrix: list[list[Fraction]]) -> bool:
    """Tell by elimination without rounding whether a symmetric rational matrix is positive semidefinite."""
    rest = [list(row) for row in matrix]
    while rest:
        pivot, row = rest[0][0], rest[0]
        if pivot < 0 or (pivot == 0 and any(row)):
            return False
        rest = [
            [a - (row[i] * b / pivot if pivot else 0) for a, b in zip(below[1:], row[1:], strict=True)]
            for i, below in enumerate(rest[1:], start=1)
        ]
    return True


def holds_exactly(proof: Certificate) -> bool:
    """Tell without rounding whether a solution satisfies every inequality."""
    exact = all(is_semidefinite(left_side(one, proof.solution)) for one in proof.inequalities.listed)
    return exact and bool((proof.solution.scalars >= 0).all())


@pytest.mark.parametrize("name", few(["lqg joint hold", "mixed model", "send-on-delta"], quick=1, start=1))
def test_certificates_hold_in_rational_arithmetic(name: str) -> None:
    """What the bound on rounding proves is true of the same numbers as fractions."""
    loop = switched(closed(POLICIES[name](make_system(1, 2, 1, 1, True))))
    decay = find_decay(loop)
    proofs = [decay.proof, find_gain(loop).proof, bound_cost(loop).proof, bound_state(loop).proof]
    proofs += [] if decay.proof_of_limit is None else [decay.proof_of_limit]
    for proof in proofs:
        assert holds_exactly(proof)
        worse = replace(proof.solution, matrices=tuple(-P for P in proof.matrices))
        assert not holds_exactly(replace(proof, solution=worse))
        assert proof.inequalities.shortfall(worse) > 0


def test_what_is_missed_by_little_is_not_verified() -> None:
    """An indefinite, a singular and a negative multiplier are no proof; a margin of a few roundings is one."""
    unit = np.eye(3)
    asked = Inequalities((3,), 1, (Inequality(np.zeros((3, 3)), [(1.0, 0, unit)]),))
    none = np.zeros(1)
    assert asked.shortfall(Unknowns((unit,), none)) == 0
    assert asked.shortfall(Unknowns((np.diag([1.0, 1.0, 1e-13]),), none)) == 0
    assert 0 < asked.shortfall(Unknowns((np.diag([1.0, 1.0, 0.0]),), none)) < 1e-13
    assert asked.shortfall(Unknowns((np.diag([1.0, 1.0, -1e-6]),), none)) == pytest.approx(1e-6, rel=1e-6)
    assert asked.shortfall(Unknowns((unit,), -np.ones(1))) == np.inf
    assert asked.shortfall(Unknowns((np.full((3, 3), np.inf),), none)) == np.inf


@pytest.mark.parametrize("seed", few(range(6), start=1))
def test_of_a_linear_loop_the_certificates_are_exact(seed: int) -> None:
    """Spectral radius, peak of the frequency response, and J_all by Riccati equations, three other computations."""
    system = make_system(seed, 1 + seed % 3, 1, 1 + seed % 2, seed % 2 == 0)
    policy = design.all_time(system.plant, system.cost)
    loop = closed(policy)
    found = switched(loop)
    decay = find_decay(found)
    assert radius(found.F[0]) <= decay.rate <= radius(found.F[0]) + 2 * HALVING
    gain = find_gain(found)
    assert peak(found) * (1 - 1e-9) <= gain.value <= peak(found) * (1 + 1e-3)
    assert (decay.residual, decay.limit, gain.residual) == (0.0, 0.0, 0.0)
    assert policy.theory.closed_form is not None
    bound = bound_cost(found).value
    assert bound == pytest.approx(policy.theory.closed_form.cost, rel=1e-4)
    assert bound >= policy.theory.closed_form.cost * (1 - 1e-9)


@pytest.mark.evidence
def test_two_masses_decay_almost_as_fast_as_under_all_time_control() -> None:
    """The filter decays faster than the loop, so that the estimate alone has the same rate as the whole."""
    problem = taciturn.load("two-mass-lqg")
    loop = problem.close(problem.design())
    whole, seen = switched(loop), switched_innovations(loop)
    rates = [find_decay(found).rate for found in (whole, seen)]
    assert abs(rates[0] - rates[1]) <= HALVING
    always = radius(whole.under(1).F[0])
    assert round(always, 4) == 0.9656  # the slowest mode of A + BL
    assert always < rates[0] < 0.98


def small(theta: float) -> Switched:
    """Return the loop of two states, held inputs."""
    system = make_system(3, 2, 1, 1, True)
    return switched(closed(design.lqg(system.plant, system.cost, theta=theta)))


@pytest.mark.evidence
@pytest.mark.parametrize("loop_of", [small, pytest.param(two_masses, marks=pytest.mark.evidence)])
def test_a_larger_theta_proves_less(loop_of: Callable[[float], Switched]) -> None:
    """Decay, gain and cost bound grow with θ, from those of sending every sample on."""
    loops = [loop_of(theta) for theta in (1e-4, 0.1, 1.0)]  # below, rounding decides about the two masses' last states
    always = loops[0].under(1)
    rates, gains = [find_decay(loop).rate for loop in loops], [find_gain(loop).value for loop in loops]
    costs = [bound_cost(loop).value for loop in loops]
    assert radius(always.F[0]) < rates[0] < rates[1] < rates[2] < 1
    assert find_gain(always).value < gains[0] < gains[1] < gains[2]
    assert bound_cost(always).value < costs[0] < costs[1] < costs[2]


@pytest.mark.parametrize("theta", [0.1, 1.0, 5.0])
def test_the_bound_on_the_cost_is_no_worse_than_the_theorem(theta: float) -> None:
    """P = (1+θ)K with the multiplier 1 is one solution: it proves (1+θ)J_all, and the least bound is below."""
    problem = taciturn.load("two-mass-lqg").changed({"theta": theta})
    loop = problem.close(problem.design())
    assert loop.policy.guarantee is not None
    assert bound_cost(switched_innovations(loop)).value <= loop.policy.guarantee.cost * (1 + 1e-6)


def test_without_noise_the_cost_ends_below_the_limit() -> None:
    """An absolute threshold leaves an unstable loop a limit cycle, whose cost is below what is proved."""
    plant, cost = Plant([[1.2]], [[1.0]], [[0.1]]), Cost([[1.0]], [[0.1]])
    loop = switched(close(plant, design.absolute(plant, cost, threshold=1.0)))
    found = find_decay(loop)
    z, late = 10 * np.random.default_rng(0).standard_normal((loop.states, 200)), 0.0
    for tick in range(400):
        values = [np.einsum("ip,ij,jp->p", z, Psi, z) + c for Psi, c in zip(loop.Psi, loop.c, strict=True)]
        taken = np.argmin(values, axis=0)
        spent = np.choose(taken, [np.einsum("ip,ij,jp->p", z, M, z) for M in loop.M])
        late = max(late, float(spent.max())) if tick >= 200 else late
        z = np.choose(taken, [F @ z for F in loop.F])
    assert 0.1 < late <= found.limit < 100 * late


def test_what_can_diverge_has_no_certificate() -> None:
    """A threshold that an unstable plant outruns: silence for ever where the state is large, refused with numbers."""
    plant, cost = Plant([[1.5]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
    loop = switched(close(plant, design.relative(plant, cost, sigma=20.0)))
    with pytest.raises(NoCertificateError, match="sends more often"):
        find_decay(loop)
    for find in (find_gain, bound_cost, bound_state):
        with pytest.raises(
            NoCertificateError, match=r"no .* can be proved by quadratic Lyapunov functions of 2 coordinates"
        ):
            find(loop)


def test_without_noise_there_is_no_gain() -> None:
    """W = 0 and no measurement noise: nothing to bound."""
    plant, cost = Plant([[1.5]], [[1.0]], [[0.0]]), Cost([[1.0]], [[1.0]])
    loop = switched(close(plant, design.relative(plant, cost, sigma=0.1)))
    with pytest.raises(NoCertificateError, match="the loop has no noise"):
        find_gain(loop)
    assert bound_cost(loop).value == pytest.approx(0.0, abs=1e-6)
    assert find_decay(loop).limit == 0


def test_a_solver_that_is_not_installed_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    """The remedy is the extra."""

    def missing(name: str) -> None:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr("taciturn_certify.inequalities.import_module", missing)
    with pytest.raises(ProblemError, match=r"clarabel is not installed.*pip install 'taciturn\[certify\]'"):
        find_decay(two_masses())
