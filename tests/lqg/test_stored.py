"""The cost of a stored loop: its enclosure contains the value at 1,024 bits, and guarantees are above it."""

from dataclasses import replace

import numpy as np
import pytest
from counts import few
from flint import arb, arb_mat
from scipy.linalg import block_diag

from taciturn import ContinuousPlant, Controller, Cost, Plant, design
from taciturn._rational import precision
from taciturn.base.certainty import design_certainty
from taciturn.lqg.discrete import discretise
from taciturn.lqg.enclosures import Balls
from taciturn.lqg.stored import Apart, allowance, filter_loop

BITS, DOUBLINGS = 1024, 40


def exact(matrix):
    """Return a matrix of doubles without an error."""
    return arb_mat(len(matrix), matrix.shape[1], matrix.ravel().tolist())


def step(problem):
    """Return A, B, Q, R, N and W of a step: doubles of a discrete plant, all digits of a sampled one."""
    p = problem.plant
    if problem.exact is None:
        return [exact(part) for part in (p.A, p.B, problem.Q, problem.R, problem.N, p.W)]
    return [part._balls.mid() for part in problem.exact.build(Balls)][:-1]


def reference(problem, steady, L, more=None):
    """Return the cost by the sum of the covariances of (x, x̂⁻), in other coordinates than those of the library.

    With ``more`` = (E, N), the input is u = Lx̂ + e with e = Ex̂ + N(y − Cx̂⁻), and the result is
    (cost, E[ee'], mean of the stage cost of (x̂, u) with the stored weights).
    """
    p, n = problem.plant, problem.plant.states
    A, B, Q, R, N, W = step(problem)
    stored, own, C, gain, V, L = map(exact, (p.A, p.B, p.C, steady.gain, p.V, L))
    left = exact(np.eye(n)) - gain * C
    E, M = map(exact, (np.zeros((p.inputs, n)), np.zeros((p.inputs, p.outputs)))) if more is None else map(exact, more)
    error = beside(E * gain * C + M * C, E * left - M * C), E * gain + M
    T, D = beside(L * gain * C, L * left) + error[0], L * gain + error[1]
    observed = beside(stored * gain * C, stored * left)
    moved = beside(A, exact(np.zeros((n, n)))) + B * T, observed + own * T
    F = arb_mat(moved[0].tolist() + moved[1].tolist())
    J = arb_mat((B * D).tolist() + (stored * gain + own * D).tolist())
    G = exact(np.eye(2 * n, n))
    S, power = G * W * G.transpose() + J * V * J.transpose(), F
    for _ in range(DOUBLINGS):
        S, power = (S + power * S * power.transpose()).mid(), (power * power).mid()
    x = G.transpose()
    M = G * Q * x + G * N * T + T.transpose() * N.transpose() * x + T.transpose() * R * T
    total = sum((M * S)[i, i] for i in range(2 * n))
    total += sum((D.transpose() * R * D * V)[i, i] for i in range(len(p.C)))
    if more is None:
        return total
    estimate = beside(gain * C, left)
    seen = arb_mat(estimate.tolist() + T.tolist()), arb_mat(gain.tolist() + D.tolist())
    weights = exact(np.block([[problem.Q, problem.N], [problem.N.T, problem.R]]))
    shown = weights * (seen[0] * S * seen[0].transpose() + seen[1] * V * seen[1].transpose())
    errors = error[0] * S * error[0].transpose() + error[1] * V * error[1].transpose()
    return total, errors, sum(shown[i, i] for i in range(n + p.inputs))


def beside(one, other):
    """Return the matrix of the columns of two matrices."""
    return arb_mat([a + b for a, b in zip(one.tolist(), other.tolist(), strict=True)])


def drawn(seed):
    """Return a random unstable problem with a cross term and a filter, sampled if the seed is odd."""
    draws = np.random.default_rng(seed)
    n, m, p = int(draws.integers(1, 6)), 2, 2
    A, half = draws.normal(size=(n, n)), draws.normal(size=(n + m, n + m))
    weight = half @ half.T
    cost = Cost(weight[:n, :n], weight[n:, n:], weight[:n, n:])
    rest = draws.normal(size=(n, m)), 0.3 * np.eye(n), draws.normal(size=(p, n)), 0.1 * np.eye(p)
    if seed % 2:
        B, W, C, V = rest
        return ContinuousPlant(A, B, W, C=C, V=V), cost, 0.1
    return Plant(1.2 * A / np.abs(np.linalg.eigvals(A)).max(), *rest), cost, None


@pytest.mark.parametrize("seed", range(8))
def test_the_enclosure_of_a_stored_loop_contains_its_value_at_1024_bits_and_guarantees_are_above(seed):
    """Unstable and sampled plants, with cross terms and filters."""
    plant, cost, period = drawn(seed)
    problem = discretise(plant, cost, period)
    found = design_certainty("lqg", problem)
    assert found.proved.radius <= 1e-9 * found.proved.value
    policy, relative = (kind(plant, cost, theta=0.1, period=period) for kind in (design.excess, design.lqg))
    with precision(BITS):
        value = reference(problem, found.filter, found.regulator.L)
        assert abs(value - arb(found.proved.value)) <= arb(found.proved.radius)
        silence = arb(policy.guarantee.per_silence)
        claimed = (value + arb(problem.noise_cost)) / arb(problem.tick if period else 1.0) + silence
        assert arb(policy.guarantee.cost) >= claimed
        claimed = (arb(1.1) * value + arb(problem.noise_cost)) / arb(problem.tick if period else 1.0)
        assert arb(relative.guarantee.cost) >= claimed
    assert policy.guarantee.proved
    assert relative.guarantee.proved
    assert not design.lqg(plant, cost, theta=0.1, period=period, trigger="separate").guarantee.proved


@pytest.mark.parametrize("seed", few(range(12), 5))
def test_the_bound_holds_for_the_errors_that_the_rounding_of_gains_makes_dearest(seed):
    """An error of the input along the rounding of L and of the filter's gain costs more than with exact gains."""
    draws = np.random.default_rng(100 + seed)
    plant, cost, period = drawn(seed)
    problem = discretise(plant, cost, period)
    exactly = design_certainty("excess", problem)
    regulator, steady = exactly.regulator, exactly.filter
    off, wrong = (1e-9 * draws.normal(size=part.shape) * part for part in (regulator.L, steady.gain))
    regulator, steady = replace(regulator, L=regulator.L + off), replace(steady, gain=steady.gain + wrong)
    loop = filter_loop(problem, steady, regulator)
    base = loop.cost()
    allowed = allowance(loop, regulator, steady, base.value)
    along = off, regulator.L @ wrong
    with precision(BITS):
        _, small, _ = reference(problem, steady, regulator.L, along)
        size = float(sum((exact(regulator.H) * small)[i, i] for i in range(plant.inputs)))
        larger = [np.sqrt(0.05 * base.value / size) * part for part in along]
        value, errors, shown = reference(problem, steady, regulator.L, larger)
        silence = sum((exact(regulator.H) * errors)[i, i] for i in range(plant.inputs))
        assert value > arb(base.upper) + silence  # the theorem for exact gains does not hold
        highest, factor = allowed.raised(base.upper, float(silence.upper()) * (1 + 1e-12))
        assert value <= arb(highest) + arb(factor) * silence
        assert highest - base.upper <= 1e-6 * base.value
        # the same error as that of a trigger relative to its stage cost: (1 + θ)s² = θ·(stage cost + tr(QΣ))
        theta = silence / (shown + arb(float(np.trace(problem.Q @ steady.posterior))) - silence)
        assert value > (1 + theta) * arb(base.upper)
        bound = allowed.relative(base, float(theta.upper()) * (1 + 1e-15))
        assert value <= arb(bound) <= (1 + theta) * arb(base.upper) * arb(1 + 1e-6)


@pytest.mark.parametrize("seed", few(range(7), 3))
def test_the_allowance_covers_the_rounding_of_contributions(seed):
    """Two sensors filter apart, with matrices that are wrong in the 13th digit; LΔ is below its bound."""
    draws = np.random.default_rng(200 + seed)
    plant, cost, period = drawn(seed)
    problem = discretise(plant, cost, period)
    found = design_certainty("distributed", problem)
    p, L, g, H = problem.plant, found.regulator.L, found.filter.gain, exact(found.regulator.H)
    n, rest = p.states, np.eye(p.states) - found.filter.gain @ p.C
    wrong = [part + 1e-13 * draws.normal(size=part.shape) * part for part in (rest, rest @ p.A)]
    allowed = found.allowance_of(Apart([[0], [1]], *wrong))
    with precision(BITS):
        A, B, _, _, _, W = step(problem)
        own, stored, V, L, left, turn, gain = map(exact, (p.B, p.A, p.V, L, *wrong, g))
        none, one, measured = exact(np.zeros((n, n))), exact(np.eye(n)), gain * exact(p.C)
        each = [exact(g[:, [i]]) * exact(p.C[[i]]) for i in range(2)]
        # states: x; the controller's part before its correction; both contributions; the prediction of the filter
        x = row([one, none, none, none, none])
        control, first, second = (
            row([none, left, *[none] * 3]),
            *(row([each[i], none, *(turn if j == i else none for j in range(2)), none]) for i in range(2)),
        )
        filtered = row([measured, none, none, none, one - measured])
        T = L * (control + first + second)
        moves = [A * x + B * T, stored * control + own * T, first, second, stored * filtered + own * T]
        D = L * gain
        seen = [exact(g * np.array(part)) for part in ([1.0, 0.0], [0.0, 1.0])]
        F, J = (
            arb_mat([line for block in blocks for line in block.tolist()])
            for blocks in (moves, (B * D, own * D, *seen, stored * gain + own * D))
        )
        G = exact(np.eye(5 * n, n))
        S, power = G * W * G.transpose() + J * V * J.transpose(), F
        for _ in range(DOUBLINGS):
            S, power = (S + power * S * power.transpose()).mid(), (power * power).mid()
        off = L * (control + first + second - filtered)  # the noise of the measurement cancels
        size = float(sum((H * off * S * off.transpose())[i, i] for i in range(p.inputs))) ** 0.5
    assert 1e-6 * allowed.fixed < size <= allowed.fixed - found.allowance.fixed
    exactly = found.allowance_of(Apart([[0], [1]], rest, rest @ p.A))
    assert found.allowance.fixed < exactly.fixed < allowed.fixed


def row(blocks):
    """Return the matrix of blocks beside each other."""
    found = blocks[0]
    for block in blocks[1:]:
        found = beside(found, block)
    return found


@pytest.mark.parametrize("seed", range(4))
def test_the_allowance_for_the_rounding_of_doubles_is_small(seed):
    """For the gains that programs hold, the bound is raised by less than 1e-9 of the cost."""
    plant, cost, period = drawn(seed)
    problem = discretise(plant, cost, period)
    found = design_certainty("excess", problem)
    highest, factor = found.raised(0.1 * found.cost_all_time, found.allowance)
    assert 0 < highest - found.proved.upper <= 1e-9 * found.cost_all_time
    assert 1 < factor <= 1 + 1e-8


def test_nothing_is_proved_of_silence_if_the_filter_depends_on_the_start():
    """No noise reaches an unstable mode: without an initial error, the mean of the state is not that of the filter."""
    problem = discretise(Plant([[1.2]], [[1.0]], [[0.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), None)
    found = design_certainty("excess", problem)
    assert found.proved is not None
    assert found.allowance is None


@pytest.mark.parametrize("others", [0, 24])
def test_a_trace_that_cancels_is_proved_with_more_digits(others: int):
    """The noise moves only a direction in which K is 1e-13 of its largest entry: doubles leave no digit of tr(KW)."""
    T = np.array([[0.6, 0.8], [-0.8, 0.6]])
    A, q = T @ np.diag([1.5, 0.5]) @ T.T, T @ np.diag([1.0, 1e-13]) @ T.T
    quiet, none = T[:, 1:] @ T[:, 1:].T, np.zeros((others, others))
    plant = Plant(
        block_diag(A, none), np.eye(2 + others)[:, :2], block_diag((quiet + quiet.T) / 2, none), np.eye(2, 2 + others)
    )
    problem = discretise(plant, Cost(block_diag((q + q.T) / 2, none), np.eye(2)), None)
    found = design_certainty("lqg", problem)
    with precision(BITS):
        value = reference(problem, found.filter, found.regulator.L)
        assert abs(value - arb(found.proved.value)) <= arb(found.proved.radius)
    assert found.proved.radius <= 1e-9 * found.proved.value


def test_the_radius_covers_a_gain_that_is_not_the_best_one():
    """A gain that is wrong by 0.1 costs more, and its own cost is enclosed."""
    problem = discretise(Plant([[1.2]], [[1.0]], [[1.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), None)
    found = design_certainty("lqg", problem)
    L = found.regulator.L + 0.1
    worse = filter_loop(problem, found.filter, replace(found.regulator, L=L)).cost()
    with precision(BITS):
        assert abs(reference(problem, found.filter, L) - arb(worse.value)) <= arb(worse.radius)
    assert worse.lower > found.proved.upper


def test_a_given_controller_has_a_proved_cost():
    """x⁺ = x/2 + u + w with u = −y/4 and y = x: the variance is 1/(1 − 1/16)."""
    kept = Controller(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[-0.25]]))
    policy = design.excess(Plant([[0.5]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), theta=0.1, controller=kept)
    assert abs(policy.cost_all_time - 17 / 15) <= policy.theory.cost_all_time_error + 2**-52 < 1e-9
    assert not policy.guarantee.proved  # what silence adds is computed in doubles
    assert policy.guarantee.cost >= 1.1 * 17 / 15 - 1e-9


def test_states_that_the_cost_does_not_see_need_not_decay():
    """A drift beside an unstable plant: neither its noise nor its mode on the unit circle counts."""
    alone = design_certainty(
        "lqg", discretise(Plant([[1.2]], [[1.0]], [[1.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), None)
    )
    both = Plant(np.diag([1.2, 1.0]), [[1.0], [0.0]], np.eye(2), np.eye(2), np.eye(2))
    found = design_certainty("lqg", discretise(both, Cost(np.diag([1.0, 0.0]), [[1.0]]), None))
    assert abs(found.proved.value - alone.proved.value) <= found.proved.radius + alone.proved.radius


def test_a_loop_without_a_cost_costs_nothing():
    """No state and no input of a stable plant has an effect on the cost."""
    found = design_certainty("lqg", discretise(Plant([[0.5]], [[1.0]], [[1.0]]), Cost([[0.0]], [[1.0]]), None))
    assert found.proved == (0.0, 0.0)
