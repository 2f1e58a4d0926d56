"""95 % intervals hold the truth as often as they should, whatever the estimator: over 60 seeds, as evidence 400."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from laws.test_estimates import COST, PLANT, SEEDS, coverage, covers

import taciturn
from taciturn import Burst, ContinuousPlant, Cost, Network, Plant, close, design
from taciturn.analyse.renewal import solve_renewal
from taciturn.errors import ProblemError, UnstableError
from taciturn.loop import Loop
from taciturn.model.link import LinkLaw
from taciturn.program.draws import MOST
from taciturn.program.engine import prepare
from taciturn.program.ops import Control, Sent
from taciturn.simulation import sampling
from taciturn.simulation.average import average, completed_squares, plain_average
from taciturn.simulation.reliability import doubt_tail
from taciturn.simulation.statistics import batch_means, controlled_mean, mean, regenerative, tail_index
from taciturn.simulation.trajectory import course

RECORDS = 100


def scalar() -> Loop:
    """Return an event-triggered loop of one state whose error a send resets."""
    plant = ContinuousPlant([[0.2]], [[1.0]], [[1.0]])
    return close(plant, design.consistent(plant, Cost([[1.0]], [[1.0]]), period=0.3))


def masses() -> Loop:
    """Return the loop of the two masses."""
    problem = taciturn.load("two-mass-lqg")
    return problem.close(problem.design())


@pytest.mark.evidence
@pytest.mark.parametrize("seeds", SEEDS)
def test_intervals_with_control_variates_cover_a_long_run(seeds: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The long run uses none, and is much longer than what it is held against."""
    loop = close(PLANT, design.lqg(PLANT, COST, theta=0.5), cost=COST)
    estimator = completed_squares(loop)
    assert estimator.controlled is not None
    with monkeypatch.context() as patch:
        patch.setattr(sampling.Sampling, "_add_controls", lambda self, history: False)
        truth = average(loop, estimator, seed=1000, steps=400_000 * seeds).cost
    monkeypatch.setattr(sampling, "SIMULATED_PATHS", 128)
    found = [average(loop, estimator, seed=seed, steps=440_000).cost for seed in range(seeds)]
    assert truth.standard_error < (0.3 if seeds < 100 else 0.1) * found[0].standard_error
    widened = [(e.value, float(np.hypot(e.standard_error, truth.standard_error))) for e in found]
    assert covers(coverage(widened, truth.value), seeds)


@pytest.mark.parametrize("seeds", SEEDS)
def test_intervals_of_rates_cover_the_quadrature(seeds: int) -> None:
    """The rate of sends, a mean over paths."""
    loop = scalar()
    truth = solve_renewal(loop).rate / loop.policy.tick
    found = [average(loop, seed=seed, steps=60_000).rates["sensor"] for seed in range(seeds)]
    assert covers(coverage([(e.value, e.standard_error) for e in found], truth), seeds)


def records(loop: Loop, paths: int, ticks: int) -> tuple[np.ndarray, np.ndarray]:
    """Return completed squares and sends of independent paths, (steps, paths), without the first steps."""
    program = loop.program()
    squares = program.sums["excess"]
    record = type(program)(**{**vars(program), "sums": {}, "outputs": {**program.outputs, "square": squares}})
    outputs = prepare(record)(loop.start(record, paths, 5), ticks + 500, None).outputs
    return outputs["square"][500:], outputs[Sent("sensor")][500:]


@pytest.mark.parametrize("paths", [RECORDS, pytest.param(400, marks=pytest.mark.evidence)])
def test_intervals_of_batch_means_and_of_cycles_cover_the_quadrature(paths: int) -> None:
    """One record of a loop each: its rate, and what silence costs; both by batches and by cycles between sends."""
    loop = scalar()
    exact, (squares, sent) = solve_renewal(loop), records(loop, paths, 6400)
    begins = np.vstack([np.zeros((1, paths)), sent[:-1]])  # a cycle begins at the step after a send
    for record, truth in ((sent, exact.rate), (squares, exact.excess)):
        batches = [batch_means(path) for path in record.T]
        assert covers(coverage([(e.value, e.standard_error) for e in batches], truth), paths)
        cycles = [regenerative(*pair) for pair in zip(record.T, begins.T, strict=True)]
        assert covers(coverage([(e.value, e.standard_error) for e in cycles], truth), paths)


@pytest.mark.parametrize("seeds", SEEDS)
def test_intervals_of_a_course_cover_what_noise_does_to_a_state(seeds: int) -> None:
    """The mean stage cost at one step from a known state: x'Qx of an input-free integrator."""
    plant, cost = Plant([[1.0]], [[1.0]], [[0.5]], mean=[2.0]), Cost([[1.0]], [[1.0]])
    policy = design.all_time(plant, cost)
    (L,) = (step.branches[0]["estimate"] for step in policy.steps if getattr(step, "signal", "") == "command")
    gain, closed = float(L[0, 0]), float(1 + L[0, 0])
    second = 4.0
    for _ in range(3):
        second = closed**2 * second + 0.5
    truth = (1 + gain**2) * second
    loop = close(plant, policy)
    found = [course(loop, 4, paths=64, seed=seed) for seed in range(seeds)]
    assert covers(coverage([(run.cost[3], run.standard_error[3]) for run in found], truth), seeds)


@pytest.mark.parametrize("seeds", SEEDS)
def test_intervals_of_missions_cover_the_exact_cost(seeds: int) -> None:
    """Twelve steps from a known state under linear feedback: the second moment, step by step."""
    plant, weights = Plant([[1.1]], [[1.0]], [[0.5]], mean=[2.0]), ([[1.0]], [[1.0]])
    policy = design.all_time(plant, Cost(*weights))
    (L,) = (step.branches[0]["estimate"] for step in policy.steps if getattr(step, "signal", "") == "command")
    gain, second, truth = float(L[0, 0]), 4.0, 0.0
    for _ in range(12):
        truth += (1 + gain**2) * second
        second = (1.1 + gain) ** 2 * second + 0.5
    loop = close(plant, policy, cost=Cost(*weights, horizon=12, terminal=[[2.0]]))
    found = [average(loop, seed=seed, steps=1200).cost for seed in range(seeds)]
    assert covers(coverage([(e.value, e.standard_error) for e in found], truth + 2 * second), seeds)


@pytest.mark.parametrize("steps", [50_000, 200_000, 1_000_000])
def test_the_error_of_a_rate_contains_the_end_of_paths_that_send_in_phase(steps: int) -> None:
    """A trigger that sends whenever a pause of two steps lets it: half of the steps, off by at most half a send."""
    A, B, C = [[0.9324, -0.1028], [0.4638, 0.2719]], [[-0.4827], [0.0737]], [[-1.2907, 0.5337]]
    plant = Plant(A, B, 0.2 * np.eye(2), C, [[0.1]])
    network = Network(links={"actuator": LinkLaw(min_interval=2, max_interval=5)})
    policy = design.dynamic(plant, Cost(np.eye(2), [[0.5]]), sigma=0.2, rho=0.8, gain=2.0)
    rate = average(close(plant, policy, network), seed=steps, steps=steps).rates["actuator"]
    assert abs(rate.value - 0.5) <= 2.1 * rate.standard_error <= 2e-3


def test_a_schedule_and_sending_always_have_rates_without_an_error_of_the_end() -> None:
    """Windows hold whole cycles, and where every step sends, no end is seen."""
    plant, cost = Plant([[0.9]], [[1.0]], [[0.1]]), Cost([[1.0]], [[1.0]])
    for policy in (design.periodic(plant, cost, every=3), design.all_time(plant, cost)):
        found = average(close(plant, policy, cost=cost), plain_average(close(plant, policy, cost=cost)), steps=50_000)
        assert found.rates["actuator"].standard_error <= 3 / found.steps


def test_the_sends_of_a_course_have_a_standard_error() -> None:
    """That of a share of the paths."""
    found = course(scalar(), 30, paths=500)
    share = found.sends["sensor"]
    expected = np.sqrt(share * (1 - share) / 499)
    assert np.allclose(found.sends_standard_error["sensor"], expected)
    assert expected.max() > 0.01


def test_control_variates_have_mean_zero_and_explain_most_of_the_variance() -> None:
    """Each is within 4.5 standard errors of 0; on the two masses the variance of the cost falls four times."""
    for loop in (masses(), scalar(), close(PLANT, design.lqg(PLANT, COST, theta=0.5), cost=COST)):
        program = loop.reduced_program() if loop.reducible else loop.program()
        names = [name for name in program.sums if isinstance(name, Control)]
        assert 0 < len(names) <= MOST
        kept = program.keep({*names, "excess"})
        run = prepare(kept)
        start = run(loop.start(kept, 4096, 3), 300, None).states
        sums = run(start, 2000, None).sums
        controls = np.array([sums[name] for name in names])
        spread = controls.std(axis=1) / np.sqrt(4096)
        assert (np.abs(controls.mean(axis=1)) < 4.5 * spread).all()
        plain, sharp = mean(sums["excess"]), controlled_mean(sums["excess"], controls)
        assert abs(plain.value - sharp.value) < 4 * plain.standard_error
        if loop.reducible and len(loop.problem.plant.A) == 4:
            assert plain.standard_error**2 > 4 * sharp.standard_error**2


def test_a_fit_takes_out_what_controls_explain() -> None:
    """Exactly, when they explain everything, whether or not some stand there twice; nothing, when they are nothing."""
    draws = np.random.default_rng(2)
    controls = draws.normal(size=(3, 200))
    values = 5.0 + 2.0 * controls[0] - controls[2]
    for doubled in (controls, np.vstack([controls, controls, np.zeros((1, 200))])):
        found = controlled_mean(values, doubled)
        assert found.value == pytest.approx(5.0, abs=1e-12)
        assert found.standard_error < 1e-12
    assert controlled_mean(values, np.zeros((0, 200))).value == pytest.approx(values.mean())
    assert controlled_mean(values, np.zeros((0, 200))).standard_error == pytest.approx(mean(values).standard_error)


def test_long_runs_use_control_variates_and_short_ones_do_not() -> None:
    """So a sharp cost takes fewer steps; both agree."""
    loop = masses()
    short, long = average(loop, steps=2_000_000).cost, average(loop, seed=1, steps=24_000_000).cost
    assert long.standard_error < short.standard_error / np.sqrt(12) / 1.5
    assert abs(long.value - short.value) < 4 * short.standard_error


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: batch_means(np.ones(100)), "record has 100 values for 32 batches; expected at least 320"),
        (lambda: batch_means(np.ones(100), 3), "batches is 3"),
        (lambda: batch_means([[1.0]]), "record has shape"),
        (lambda: batch_means([1.0, np.nan] * 400), "expected an array of finite numbers"),
        (lambda: batch_means([1e308] * 1000), r"record contains the number 1e\+308"),
        (lambda: batch_means([1e308, -1e308] * 500), "expected an array of numbers with finite squares"),
        (lambda: batch_means([1e200] * 999 + [-1e200] * 999), "expected an array of numbers with finite squares"),
        (lambda: regenerative([1e307] * 1003, np.ones(1003)), "expected an array of numbers with finite squares"),
        (lambda: regenerative(np.ones(5), np.ones(4)), "record has 5 steps and renewals has 4"),
        (lambda: regenerative(np.ones(4), [0, 1, 2, 0]), "other than 0 and 1"),
        (lambda: regenerative(np.ones(40), np.zeros(40)), "record has 0 complete cycles; expected at least 30"),
    ],
)
def test_records_that_give_no_mean_are_refused(call: object, message: str) -> None:
    """In one sentence."""
    assert callable(call)
    with pytest.raises(ProblemError, match=message):
        call()


def walk(A: float = 1.0, theta: float = 0.1, loss: float = 0.0) -> Loop:
    """Return x⁺ = Ax + u + w under the excess trigger, over a link that drops packets."""
    plant, cost = Plant([[A]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
    network = Network("udp", actuator_loss=loss) if loss else None
    return close(plant, design.excess(plant, cost, theta=theta), network, cost)


@pytest.mark.evidence
def test_a_loop_that_hardly_ever_sends_is_no_average() -> None:
    """A random walk below a threshold of a thousand deviations, which a stable plant never reaches either."""
    (told,) = average(walk(theta=1e6), steps=500_000).notes
    assert told.startswith("nothing was sent on the actuator link in the 4999")
    early = average(walk(theta=1e3), steps=20_000)
    assert early.rates["actuator"].value > 0
    assert early.notes[0].startswith("the loop has not settled within 20000 steps")
    assert not early.settled
    loose = average(walk(theta=1e3), standard_error=1e3)  # which the walk keeps long before it has sent
    assert loose.rates["actuator"].value > 0.01
    (told,) = average(walk(theta=1e6, A=0.9), steps=500_000).notes
    assert told.endswith("steps: the cost is that of silence")
    assert average(walk(), steps=500_000).notes == ()


def test_an_average_that_a_few_paths_decide_is_told() -> None:
    """Half of the packets of x⁺ = 1.3 x + u + w are lost, and an input is held that does not fit."""
    found = average(walk(A=1.3, loss=0.5), steps=1_000_000)
    assert found.cost.standard_error > found.cost.value / 3
    assert found.notes[0].startswith("the variance of the cost is infinite: an outage of the actuator link lasts")
    assert "its mean square may not exist" in found.notes[-1]
    assert average(walk(A=1.3, loss=0.05), steps=1_000_000).notes == ()


def test_outages_decide_whether_a_mean_and_a_variance_exist() -> None:
    """In k steps without a packet, of probability q^k, a square grows a^2k times: finite where qa² < 1, or qa⁴ < 1."""
    plant, cost = Plant([[1.5]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])

    def found(loss: float = 0.0, burst: Burst | None = None, plain: bool = True) -> tuple[str, ...]:
        network = Network("tcp", sensor_loss=loss, sensor_burst=burst)
        loop = close(plant, design.lossy_lqg(plant, cost, price=0.1, network=network.without_bursts()), network, cost)
        return average(loop, plain_average(loop) if plain else None, steps=200_000).notes

    assert not any("variance" in note for note in found(0.19))  # 1.5⁴ · .19 = .96
    assert any("the squared cost grows by a factor of 5.062" in note for note in found(0.2))
    assert found(0.2, plain=False) == ()  # terms between 0 and the price
    bursts = Burst(to_bad=0.1, to_good=0.6, loss_good=0.0, loss_bad=1.0)  # huang2007: 4.214 ± a useless error
    assert any(
        "another step with probability 0.4, and in this step the squared" in note for note in found(burst=bursts)
    )
    with pytest.raises(
        UnstableError, match=r"another step with probability 0.45, and in this step the mean square .* 2.25"
    ):
        found(burst=replace(bursts, to_good=0.55))
    assert Network("udp", actuator_burst=Burst(0.2, 0.3, 0.1, 0.4)).outage("actuator") == pytest.approx(
        max(np.roots([1.0, -(0.8 * 0.1 + 0.7 * 0.4), (0.8 * 0.7 - 0.2 * 0.3) * 0.1 * 0.4]))
    )


def test_limited_inputs_do_not_hold_an_unstable_plant_for_ever() -> None:
    """Beyond limit/(a − 1) no input brings it back, and normal noise gets there; a random walk comes back."""
    cost = Cost([[1.0]], [[0.5]])

    def notes(A: float) -> tuple[str, ...]:
        plant = Plant([[A]], [[1.0]], [[1.0]], input_limit=[2.6])
        return average(close(plant, design.all_time(plant, cost), cost=cost), steps=200_000).notes

    assert notes(1.3)[0].startswith("the plant is unstable and its inputs are limited: the noise eventually")
    assert notes(1.0) == ()


TURNING = 1.05 * np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])


@pytest.mark.parametrize(
    ("A", "B", "limits", "lost"),
    [
        ([[1.1]], [[1.0]], {"input_limit": [[-np.inf, 3.0]]}, True),
        ([[1.1]], [[1.0]], {"input_rate": [3.0]}, True),
        ([[1.1]], [[1.0, 0.5]], {"input_limit": [3.0, [-3.0, np.inf]]}, True),
        ([[1.1]], [[1.0, 0.5]], {"input_limit": [[-np.inf, 3.0], [-3.0, np.inf]]}, False),
        ([[1.1]], [[1.0, -0.5]], {"input_limit": [[-np.inf, 3.0], [-3.0, np.inf]]}, True),
        ([[1.1]], [[1.0, 0.5]], {"input_limit": [3.0, np.inf]}, False),
        ([[1.1, 0.0], [0.0, 0.5]], [[1.0, 0.0], [0.0, 1.0]], {"input_limit": [3.0, np.inf]}, True),
        ([[1.1, 0.0], [0.0, 0.5]], [[1.0, 0.0], [0.0, 1.0]], {"input_limit": [np.inf, 3.0]}, False),
        (TURNING, [[1.0], [0.0]], {"input_limit": [[-np.inf, 3.0]]}, False),
        (TURNING, [[1.0], [0.0]], {"input_limit": [3.0]}, True),
    ],
)
def test_each_growing_mode_needs_inputs_without_limits(A: Any, B: Any, limits: dict[str, Any], lost: bool) -> None:
    """A real one in both directions, one that turns in one; otherwise a note says that there is no average."""
    n, m = np.shape(B)
    plant, cost = Plant(A, B, 0.01 * np.eye(n), **limits), Cost(np.eye(n), np.eye(m))
    loop = close(plant, design.all_time(plant, cost))
    found = average(loop, steps=4096)
    assert any("no average exists" in note for note in found.notes) == lost
    beside = taciturn.evaluate(loop.policy, steps=4096).without_limits
    assert beside is not None
    assert (beside.share is None) == lost
    assert (beside.document()["share_at_limit"] is None) == lost
    assert ("has no average" in beside.sentence("step")) == lost


def test_a_tail_without_a_variance_is_told_from_those_with_one() -> None:
    """Pareto's law has the index that it says, within four of the standard errors of 64 values; others are lighter."""
    draws = np.random.default_rng(3)
    for index in (1.1, 1.5, 3.0):
        assert abs(tail_index(draws.pareto(index, 4096)) / index - 1) <= 4 / 8
    for light in (draws.normal(size=4096), draws.exponential(size=4096), draws.chisquare(1, size=4096)):
        assert tail_index(light) > 2
    assert tail_index(draws.pareto(1.1, 4095)) == np.inf
    assert doubt_tail(1.2)[0].startswith("the highest costs of paths follow a power law of index 1.2")
    assert doubt_tail(2.5) == ()


@pytest.mark.parametrize("A", [1.0, 1.05])
def test_a_link_that_loses_every_packet_leaves_no_average(A: float) -> None:
    """All paths grow alike, so that none is ahead of the others; a stable plant comes to rest by itself."""
    with pytest.raises(UnstableError, match="the actuator link drops every packet"):
        average(walk(A=A, loss=1.0), steps=100_000)
    stable = average(walk(A=0.5, loss=1.0), steps=1_000_000)
    assert abs(stable.cost.value - 1 / (1 - 0.5**2)) <= 4 * stable.cost.standard_error
