"""Who may send, what loops on a channel cost, and what is known of it beforehand."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from drawn import rows
from hypothesis import given, settings
from hypothesis import strategies as st

import taciturn
from taciturn import PID, Cost, Estimate, Plant, Problem, ProblemError, UnstableError
from taciturn._arrays import Array
from taciturn.model.network import Network
from taciturn.model.trigger import Form
from taciturn.renewal.chain import Chain
from taciturn.renewal.gaussian import solve_gaussian
from taciturn_channel.classes import Clocked, LoopClass, gather
from taciturn_channel.prices import Curves
from taciturn_channel.schedulers import SCHEDULERS, best_stretch
from taciturn_channel.share import share_channel
from taciturn_channel.simulated import (
    RULE_ERROR,
    Grant,
    Group,
    MostUrgent,
    Places,
    RandomAccess,
    RoundRobin,
    SharedChannel,
    TimeDivision,
    contend,
    measure_freely,
)
from taciturn_limits.bounds import solve_optimum

UNIT = np.eye(1)
WALK = Problem(Plant([[1.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), Network(), "all-time", {})


def test_the_most_urgent_take_all_slots() -> None:
    """The capacity on each channel, whether they want to or not."""
    urgency = np.array([[3.0, -1.0, 2.0, 5.0], [-1.0, -2.0, 0.5, -3.0]])
    grant = MostUrgent(2).grant(0, np.arange(4), urgency)
    assert grant.sent.tolist() == [[True, False, False, True], [True, False, True, False]]
    assert grant.busy.tolist() == [2.0, 2.0]
    assert MostUrgent(9).grant(0, np.arange(4), urgency).sent.all()


def test_round_robin_gives_each_its_turn() -> None:
    """After seven turns of three all have sent three times, in the same order; not all need be there."""
    access, everybody = RoundRobin(3, 7), np.arange(7)
    sent = np.array([access.grant(tick, everybody, np.ones((2, 7))).sent[0] for tick in range(14)])
    assert (sent.sum(axis=1) == 3).all()
    assert sent[:7].sum(axis=0).tolist() == [3] * 7
    assert sent[0].nonzero()[0].tolist() == [0, 1, 2]
    assert sent[2].nonzero()[0].tolist() == [0, 1, 6]
    assert access.grant(14, np.array([4, 5]), np.ones((1, 2))).sent.tolist() == [[True, True]]


def test_time_division_keeps_rates_and_capacity() -> None:
    """Everyone's number of sends is its rate times the steps, within one; intervals are the two nearest to 1/rate."""
    rates = np.repeat([0.4, 0.25, 0.125], [5, 4, 8])
    phases = np.concatenate([(np.arange(n) + 0.5) / n for n in (5, 4, 8)])
    access, everybody = TimeDivision(4, rates, phases), np.arange(17)
    sent = np.array([access.grant(tick, everybody, np.ones((1, 17))).sent[0] for tick in range(400)])
    assert sent.sum(axis=1).max() <= 4
    assert (abs(sent.sum(axis=0) - 400 * rates) <= 2).all()
    fourth = np.diff(sent[:, 5].nonzero()[0])
    assert set(fourth.tolist()) <= {3, 4, 5}
    never = TimeDivision(4, np.array([0.0, 1.0]), np.array([0.5, 0.5]))
    assert never.grant(3, np.arange(2), np.ones((1, 2))).sent.tolist() == [[False, True]]


def test_a_saturated_random_access_carries_one_in_e() -> None:
    """All want to send always: some 1/e of the slots carry a packet, as slotted ALOHA does at its best."""
    access, slots = RandomAccess(20, seed=1), 20
    grants = [access.grant(tick, np.arange(300), np.ones((3, 300))) for tick in range(1200)]
    carried = np.array([grant.sent.sum(axis=1) for grant in grants[200:]]) / slots
    mean, spread = carried.mean(), carried.std() / np.sqrt(carried.size)
    assert abs(mean - np.exp(-1)) < 4 * spread + 0.005  # e^-1 is the limit of many loops
    assert all((grant.busy >= grant.sent.sum(axis=1)).all() for grant in grants)


def test_two_who_meet_in_the_only_slot_both_fail() -> None:
    """With one slot a step has one packet, or none gets through."""
    access = RandomAccess(1, seed=3)
    grants = [access.grant(tick, np.arange(2), np.ones((50, 2))) for tick in range(40)]
    assert all((grant.sent.sum(axis=1) == (grant.busy == 1)).all() for grant in grants)
    assert any((grant.busy == 2).any() for grant in grants)


def test_loops_that_never_wait_cost_what_the_renewal_equations_say() -> None:
    """A threshold on each loop and room for all: rate and cost of quadrature, to the standard error."""
    F, Gamma = np.array([[1.1, 0.3], [0.0, 0.8]]), np.array([[1.0, 0.2], [0.2, 0.5]])
    noise = 0.2 * np.eye(2)
    exact = solve_gaussian(Chain(F, noise, Gamma, 1.5, Gamma))
    sends, costs = measure_freely(Group(F, noise, Gamma, Form((RULE_ERROR,), Gamma, -1.5), 4096), 600, seed=1)
    for values, expected in ((costs, exact.excess), (sends, exact.rate)):
        assert abs(values.mean() - expected) < 4 * values.std(ddof=1) / np.sqrt(len(values))


def test_the_machine_and_numpy_take_the_same_ticks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without llvmlite the channel runs in NumPy: the same sends, the same costs to rounding."""
    group = Group(np.array([[1.1]]), UNIT, UNIT, Form((RULE_ERROR,), UNIT, -2.0), 50)
    fast = SharedChannel([group], MostUrgent(10), channels=2, seed=4).run(60)
    monkeypatch.setattr("taciturn.program.machine.available", lambda: False)
    slow = SharedChannel([group], MostUrgent(10), channels=2, seed=4).run(60)
    assert (fast.sends == slow.sends).all()
    assert fast.cost == pytest.approx(slow.cost, rel=1e-12)
    assert contend(group).inputs == ("granted",)


def test_a_loop_that_looks_half_as_often_counts_as_it_should() -> None:
    """Round robin of loops that look at every step and at every other one: exact rates and costs."""
    slow = Group(UNIT, UNIT, 2 * UNIT, Form(constant=1.0), 8, every=2)
    quick = Group(UNIT, UNIT, UNIT, Form(constant=1.0), 8)
    channel = SharedChannel([slow, quick], RoundRobin(4, 16), channels=400)
    channel.run(80)
    found = channel.run(800)
    assert found.sends.mean(axis=0) == pytest.approx([2.0, 2.0])
    # of slow ones every second look is sent, of quick ones every fourth: (1/2)·1·2/2 and (1+2+3)/4
    assert found.cost.mean(axis=0) == pytest.approx([8 * 0.5, 8 * 1.5], rel=0.02)


def test_the_price_loads_the_channel_as_asked() -> None:
    """By quadrature, which the search does not use: the rate at the price, where the best trigger is known."""
    kinds = gather({"walk": WALK}, [100])
    curves = Curves(kinds)
    price = curves.price_of(20.0, 1.0)
    exact = solve_optimum(
        taciturn.close(WALK.plant, taciturn.design.excess(WALK.plant, WALK.cost, delta=1.0, actuation="model")), price
    )
    assert exact.rate == pytest.approx(0.2, rel=0.015)
    bound = curves.bound(curves.settle(price, 0.999), 20.0, price)
    dual = 100 * (kinds[0].cost_all_time + exact.cost) - 20 * price
    assert bound.confidence is None
    assert bound.cost == pytest.approx(dual, rel=1e-3)
    assert bound.cost < dual


def test_a_clock_is_as_good_as_exact_where_it_can_be_kept() -> None:
    """Equal loops and a whole interval: round robin and time division attain the best periodic allocation."""
    for scheduler in ("round-robin", "tdma"):
        found = share_channel({"walk": WALK}, copies=40, capacity=10, scheduler=scheduler)
        assert abs(found.cost.value - found.cost_periodic) < 4 * found.cost.standard_error
        assert found.consistent is None
        assert found.load.value == pytest.approx(10)


def test_loops_that_all_can_send_always_cost_no_more() -> None:
    """The capacity is the number of loops."""
    found = share_channel({"walk": WALK}, copies=5, capacity=5)
    assert found.cost == Estimate(found.cost_all_time, 0.0, "simulation")
    assert found.price == 0.0
    assert found.lower_bound.cost == found.cost_all_time
    assert found.load.value == 5


@pytest.mark.evidence
def test_loops_that_decay_are_left_alone_where_sends_are_dear() -> None:
    """Next to loops that wander, one that forgets quickly gets nothing, and nobody is refused."""
    calm = Problem(Plant([[0.2]], [[1.0]], [[1e-3]]), WALK.cost, Network(), "all-time", {})
    found = share_channel({"walk": WALK, "calm": calm}, copies=[50, 50], capacity=10, scheduler="tdma", steps=2000)
    assert found.shares[1].rate.value == 0.0
    dear = share_channel({"walk": WALK, "calm": calm}, copies=[50, 50], capacity=10, steps=2000)
    assert dear.shares[1].rate.value < 0.01
    assert dear.lower_bound.cost <= dear.cost.value + 4 * dear.cost.standard_error


def test_loops_without_noise_need_nothing() -> None:
    """Nothing is sent on their behalf, and the others get the channel."""
    still = Problem(Plant([[1.0]], [[1.0]], [[0.0]]), WALK.cost, Network(), "all-time", {})
    found = share_channel({"still": still, "walk": WALK}, copies=[6, 3], capacity=3, steps=500)
    assert found.shares[0].cost == Estimate(0.0, 0.0, "simulation")
    assert found.cost.value == pytest.approx(found.cost_all_time, rel=1e-3)


def test_silence_that_costs_nothing_is_no_error() -> None:
    """A loop whose error is forgotten at once has nothing to send, by any scheduler."""
    forgets = Problem(Plant([[0.0]], [[1.0]], [[1.0]]), WALK.cost, Network(), "all-time", {})
    for scheduler in SCHEDULERS:
        found = share_channel({"forgets": forgets}, copies=3, capacity=1, scheduler=scheduler, steps=200)  # pyright: ignore[reportArgumentType]
        assert found.cost.value == pytest.approx(found.cost_all_time)


@pytest.mark.evidence
@pytest.mark.parametrize(
    ("A", "loops", "slots"),
    rows([(1.0, 400, 2), (0.9, 200, 2), (0.9, 50, 1), (3.0, 3, 1), (1.2, 10, 4)], quick=1, start=3),
)
def test_a_common_price_is_as_good_as_the_rules_that_have_none(A: float, loops: int, slots: int) -> None:
    """Rare sends, few loops, errors that grow quickly or decay: no worse than the best clock, or the largest error."""
    problem = Problem(Plant([[A]], [[1.0]], [[1.0]]), WALK.cost, Network(), "all-time", {})
    found = {
        name: share_channel({"a": problem}, copies=loops, capacity=slots, scheduler=name, steps=3000)  # pyright: ignore[reportArgumentType]
        for name in ("price", "largest")
    }
    price, largest = found["price"], found["largest"]
    spread = np.hypot(price.cost.standard_error, largest.cost.standard_error)
    assert price.cost.value <= largest.cost.value + 4 * spread + 0.002 * (price.cost.value - price.cost_all_time)
    assert price.consistent is True
    assert price.load.value == pytest.approx(slots)
    assert price.load_expected is not None
    assert price.load_expected.value == pytest.approx(slots, rel=0.05)


@pytest.mark.evidence
def test_the_rate_falls_with_the_price_however_fast_an_error_grows() -> None:
    """Where no fit converges, thresholds that send more often than at half the price are not the best there are."""
    (kind,) = gather({"wild": Problem(Plant([[3.0]], [[1.0]], [[1.0]]), WALK.cost, Network(), "all-time", {})}, [1])
    rates = [Curves([kind]).load(4.0**octaves) for octaves in range(5, 14, 2)]
    assert (np.diff(rates) < 0).all()
    assert rates[-1] > 0.05


CLASH = {  # looks 0.1 s and 0.03 s apart meet now and then, and in most hundredths of a second there is none
    name: Problem(
        taciturn.ContinuousPlant([[A]], [[1.0]], [[1.0]]), WALK.cost, Network(), "consistent", {"period": period}
    )
    for name, A, period in (("slow", 0.1, 0.1), ("fast", 0.5, 0.03))
}


@pytest.mark.evidence
def test_where_looks_meet_the_largest_loss_goes_first() -> None:
    """At no price, as there are slots enough in the mean; and none is called worse than a clock that cannot be."""
    price, largest, turns = (
        share_channel(CLASH, copies=2, capacity=1, scheduler=name, steps=3000, confidence=0)  # pyright: ignore[reportArgumentType]
        for name in ("price", "largest", "round-robin")
    )
    assert price.price == 0
    assert price.cost == largest.cost
    assert price.cost.value < turns.cost.value
    for found in (price, largest, turns):
        assert found.cost.value > found.cost_periodic
        assert found.consistent is None
        assert any("which periodic control may not attain" in note for note in found.notes)


def test_loops_without_noise_send_at_no_price() -> None:
    """And cost what the best clock does, exactly: that is consistent."""
    still = Problem(Plant([[0.9]], [[1.0]], [[0.0]]), WALK.cost, Network(), "all-time", {})
    found = share_channel({"still": still}, copies=3, capacity=1, steps=200)
    assert (found.price, found.cost.value, found.consistent) == (0.0, 0.0, True)
    assert found.load_expected == Estimate(0.0, 0.0, "exact")


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"network": Network(payload="int16", actuator_range=(1.0,))}, "the shared channel replaces the network"),
        ({"plant": Plant([[1.0]], [[1.0]], [[1.0]], function=lambda x, u, w: np.sin(x) + u + w)}, "a linear plant"),
        ({"plant": Plant([[1.0]], [[1.0]], [[1.0]], input_limit=[1.0])}, "on the shared channel"),
        ({"controller": PID(1.0)}, r"expected no \[controller\]"),
    ],
)
def test_what_loops_on_a_channel_cannot_have_is_refused(changed: dict[str, object], told: str) -> None:
    """Rounded packets, plants that are not linear, inputs that are clipped, and controllers that are kept."""
    with pytest.raises(ProblemError, match=told):
        share_channel({"a": replace(WALK, **changed)}, copies=3, capacity=1)  # pyright: ignore[reportArgumentType]


@pytest.mark.evidence
def test_the_same_seed_gives_the_same_numbers() -> None:
    """Another one gives others that agree."""
    first, again, other = (
        share_channel({"walk": WALK}, copies=12, capacity=3, steps=4000, seed=seed) for seed in (3, 3, 4)
    )
    assert first.cost == again.cost
    assert first.cost != other.cost
    spread = np.hypot(first.cost.standard_error, other.cost.standard_error)
    assert abs(first.cost.value - other.cost.value) < 4 * spread


@pytest.mark.evidence
def test_a_loop_that_gets_too_little_is_refused_with_the_rate_it_needs() -> None:
    """One of two kinds is starved by equal turns, though not by the best rates; the least rate is that of a clock."""
    wild = Problem(Plant([[1.6]], [[1.0]], [[1.0]]), WALK.cost, Network(), "all-time", {})
    problems = {"calm": WALK, "wild": wild}
    with pytest.raises(UnstableError, match=r"wild: .* send 0\.0\d+ times per check") as refused:
        share_channel(problems, copies=[100, 2], capacity=4, scheduler="round-robin", steps=2000)
    least = float(str(refused.value).split("expected at least ")[1].split(" ")[0])
    rates = least * np.array([0.9, 1.1])
    clocked = gather({"wild": wild}, [1])[0].clocked
    assert clocked.cost(rates[0]) > 1e6 > clocked.cost(rates[1])
    fine = share_channel(problems, copies=[100, 2], capacity=4, scheduler="tdma", steps=2000)
    assert fine.shares[1].rate.value > least
    with pytest.raises(UnstableError, match="the loops of wild are unstable"):
        share_channel({"wild": wild}, copies=60, capacity=6, scheduler="random-access", steps=2000)


def different(seed: int, many: int, states: int = 1) -> dict[str, Problem]:
    """Return random problems of equal structure, stable and unstable."""
    draws = np.random.default_rng(seed)
    found: dict[str, Problem] = {}
    for i in range(many):
        A = draws.standard_normal((states, states))
        A *= draws.uniform(0.8, 1.2) / np.abs(np.linalg.eigvals(A)).max()
        root = draws.standard_normal((states, states))
        plant = Plant(A, draws.standard_normal((states, 1)), root @ root.T + 0.1 * np.eye(states))
        found[f"kind {i}"] = Problem(plant, Cost(np.eye(states), [[0.1]]), Network(), "all-time", {})
    return found


@settings(max_examples=3, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["largest", "once-discard", "round-robin", "tdma", "random-access"]))
def test_copies_of_one_problem_are_as_many_equal_problems(seed: int, scheduler: str) -> None:
    """Given as copies or one by one, the loops have the same draws: the same sends, costs equal to rounding."""
    (one,) = different(seed, 1, states=1 + seed % 3).values()
    told = {"capacity": 2, "scheduler": scheduler, "steps": 128, "confidence": 0.0, "seed": seed % 1000}
    if scheduler == "random-access":  # whose collisions leave an unstable loop too little
        told |= {"capacity": 5}
    try:
        copies = share_channel({"one": one}, copies=6, **told)  # pyright: ignore[reportArgumentType]
    except UnstableError:
        with pytest.raises(UnstableError):
            share_channel({f"kind {i}": one for i in range(6)}, copies=1, **told)  # pyright: ignore[reportArgumentType]
        return
    kinds = share_channel({f"kind {i}": one for i in range(6)}, copies=1, **told)  # pyright: ignore[reportArgumentType]
    assert kinds.load == copies.load
    assert kinds.cost.value == pytest.approx(copies.cost.value, rel=1e-12)
    assert kinds.cost_periodic == pytest.approx(copies.cost_periodic, rel=1e-12)


def test_equal_problems_share_their_price_and_their_bound() -> None:
    """Six copies, six equal problems, and four and two copies: one price, one bound."""
    found = [
        share_channel(dict.fromkeys(names, WALK), copies=copies, capacity=2, steps=128)
        for names, copies in (("a", [6]), ("abcdef", [1]), ("ab", [4, 2]))
    ]
    assert [one.price for one in found[1:]] == pytest.approx([found[0].price] * 2, rel=1e-12)
    for one in found[1:]:
        assert one.lower_bound.cost == pytest.approx(found[0].lower_bound.cost, rel=1e-12)
        assert one.cost.value == pytest.approx(found[0].cost.value, rel=1e-12)


@pytest.mark.evidence
def test_the_order_of_the_loops_does_not_matter() -> None:
    """Their costs within standard errors; schedules and the bound to rounding, by workers or without."""
    problems = different(5, 4)
    turned = dict(reversed(problems.items()))
    first, other = (
        share_channel(each, copies=3, capacity=4, scheduler="largest", steps=1000, confidence=0)
        for each in (problems, turned)
    )
    spread = np.hypot(first.cost.standard_error, other.cost.standard_error)
    assert abs(first.cost.value - other.cost.value) < 4 * spread
    assert other.cost_periodic == pytest.approx(first.cost_periodic, rel=1e-9)
    few = different(6, 2, states=3)
    here = Curves(gather(few, [3]), 4)
    settled = here.settle(2.0, 0.99)
    with ThreadPoolExecutor(2) as pool:
        there = Curves(gather(dict(reversed(few.items())), [3]), 4, pool)
        again = there.settle(2.0, 0.99)
    for one, same in zip(settled, reversed(again), strict=True):
        assert one.least == same.least
        assert one.schedule.rate == same.schedule.rate
        assert one.schedule.urgency.constant == same.schedule.urgency.constant
    bounds = here.bound(settled, 0.5, 2.0, 0.99), there.bound(again, 0.5, 2.0, 0.99)
    assert bounds[1].cost == pytest.approx(bounds[0].cost, rel=1e-12)
    assert bounds[0].cost > sum(kind.count * kind.cost_all_time for kind in here.kinds)


@pytest.mark.evidence
def test_progress_only_grows_and_ends_at_one() -> None:
    """From the first rate of the first kind to the last step."""
    told: list[float] = []
    share_channel(different(3, 3), copies=1, capacity=1, steps=256, progress=told.append)
    assert told == sorted(told)
    assert 0 < told[0] < 0.5
    assert told[-1] == 1.0


def test_loops_of_different_numbers_run_as_each_would_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Constants of each path, of all paths, or NumPy: the same sends, and the same costs to rounding."""
    groups = [
        Group(UNIT * (1.1 + i / 9), UNIT * (1.5 + i), UNIT, Form((RULE_ERROR,), UNIT * (1.2 + i / 7), -2.1 - i), 3 + i)
        for i in range(4)
    ]
    channel = SharedChannel(groups, MostUrgent(5), channels=3, seed=4)
    assert len(channel.cohorts) == 1
    together = channel.run(60)
    monkeypatch.setattr("taciturn.program.engine.MANY", 12)
    parted = SharedChannel(groups, MostUrgent(5), channels=3, seed=4).run(60)
    monkeypatch.setattr("taciturn.program.machine.available", lambda: False)
    plain = SharedChannel(groups, MostUrgent(5), channels=3, seed=4).run(60)
    assert (together.sends == parted.sends).all()
    assert (together.cost == parted.cost).all()
    assert (together.sends == plain.sends).all()
    assert plain.cost == pytest.approx(together.cost, rel=1e-12)


def test_what_is_no_problem_is_refused() -> None:
    """Before anything is computed."""
    with pytest.raises(ProblemError, match="problems"):
        share_channel({}, copies=1, capacity=1)
    with pytest.raises(ProblemError, match="problems"):
        share_channel({"a": 3}, copies=1, capacity=1)  # pyright: ignore[reportArgumentType]


@pytest.mark.evidence
def test_ten_thousand_loops_are_within_two_percent_of_what_none_can_beat() -> None:
    """Two thousand of them are of another kind; the gap is of the whole cost, and above its error."""
    names = ("wiener-double-integrator", "inverted-pendulum")
    problems = {name: taciturn.load(name) for name in names}
    found = share_channel(problems, copies=[8000, 2000], capacity=1000)
    assert 0 < (found.cost.value + 4 * found.cost.standard_error) / found.lower_bound.cost - 1 < 0.02
    assert found.consistent is True


@pytest.mark.evidence
def test_a_bound_on_periodic_control_is_called_a_bound_where_no_schedule_is_known_to_attain_it() -> None:
    """Loops that differ may attain it with shared slots, or not; equal loops take turns and attain the bound."""
    loud = replace(WALK, plant=Plant([[1.0]], [[1.0]], [[3.0]]))
    one = share_channel({"walk": WALK, "loud": loud}, copies=[3, 5], capacity=3, steps=2000, confidence=0)
    assert not one.clock_attained
    assert one.cost_periodic < one.cost_periodic_attained < 1.001 * one.cost_periodic
    told = " ".join(str(one).split())
    assert f"lower bound, periodic {one.cost_periodic:.6g}" in told
    assert f"periodic, best found {one.cost_periodic_attained:.6g}" in told
    assert any("is a lower bound by the mean load" in note for note in one.notes)
    assert one.consistent is not False
    for copies, capacity in (([3], 2), ([2, 1], 1)):
        problems = dict([("walk", WALK), ("loud", loud)][: len(copies)])
        same = share_channel(problems, copies=copies, capacity=capacity, steps=2000, confidence=0)
        assert same.clock_attained
        assert same.notes == ()
        assert "best periodic" in str(same)


@pytest.mark.parametrize(("copies", "capacity"), [([20, 10], 7), ([7, 2], 2)])
def test_no_schedule_of_time_division_costs_less_than_the_best_periodic_one_that_was_found(
    copies: list[int], capacity: int
) -> None:
    """It shares slots between problems; the best schedule with slots apart costs up to 7 % more."""
    loud = replace(WALK, plant=Plant([[1.0]], [[1.0]], [[3.0]]))
    problems = {"walk": WALK, "loud": loud}
    found = share_channel(problems, copies=copies, capacity=capacity, scheduler="tdma", steps=4000, confidence=0)
    assert found.cost.value > found.cost_periodic_attained - 4 * found.cost.standard_error
    assert found.cost.standard_error < 0.0012 * found.cost.value


class Word:
    """An access rule that repeats the numbers of the loops that may send."""

    def __init__(self, word: list[int]) -> None:
        """Store the word."""
        self.word = word

    def grant(self, tick: int, at: Places, urgency: Array) -> Grant:
        """Let one loop send, if it checks."""
        sent = (at == self.word[tick % len(self.word)])[None]
        return Grant(sent, sent.sum(axis=1).astype(np.float64))


def test_a_stretch_that_repeats_costs_the_sum_over_its_intervals() -> None:
    """Random walks: k checks of silence cost k(k − 1)/2 times noise and weight; one loop checks at every other step."""
    quiet, loud = (Clocked(UNIT, size * UNIT, UNIT) for size in (1.0, 3.0))
    sharers, rates = [LoopClass(quiet, 2), LoopClass(loud, 1)], np.array([0.375, 0.25])
    assert best_stretch(sharers, Word([0, 1, 0, 2]), rates, 1) == pytest.approx((2 * 1 + 6 + 3 * 6) / 4)
    slow = [LoopClass(quiet, 1), LoopClass(loud, 2, 2)]  # the loops 1 and 2 check at even and at odd steps
    assert best_stretch(slow, Word([1, 0, 0, 2]), np.array([0.5, 0.25]), 2) == pytest.approx((0 + 3 + 2 * 3) / 4)
    assert best_stretch(sharers, Word([0, 1]), np.array([0.5, 0.0]), 1) == np.inf  # a walk that nobody hears
