"""Moments of loops over links that drop packets: against matrices by hand, bursts, and what is simulated."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

import taciturn
from taciturn import Burst, Cost, Network, Plant, UnstableError, average, close, design
from taciturn.analyse import switched as module
from taciturn.analyse.switched import outcomes
from taciturn.model.operating_point import OperatingPoint


def by_hand(a: float, q: float, r: float, loss: float) -> tuple[float, float, float]:
    """Return growths of the second and fourth moments of x⁺ = ax + û + w, û held where a packet is lost; the cost."""
    K = solve_discrete_are([[a]], [[1.0]], [[q]], [[r]])[0, 0]
    L = -a * K / (r + K)
    arrives, lost = np.array([[a + L, 0], [L, 0]]), np.array([[a, 1], [0, 1]])
    two = (1 - loss) * np.kron(arrives, arrives) + loss * np.kron(lost, lost)
    four = sum(p * np.kron(np.kron(F, F), np.kron(F, F)) for p, F in ((1 - loss, arrives), (loss, lost)))
    growths = [float(np.abs(np.linalg.eigvals(M)).max()) for M in (two, four)]
    S = np.linalg.solve(np.eye(4) - two, [1.0, 0, 0, 0]).reshape(2, 2)  # at steps before the decision
    return growths[0], growths[1], q * S[0, 0] + r * S[1, 1]


@pytest.mark.parametrize(
    ("a", "q", "r", "loss"), [(1.05, 1.0, 0.01, 0.3), (0.95, 1.0, 0.001, 0.36), (1.5, 1.0, 5.0, 0.15)]
)
def test_moments_grow_as_matrices_by_hand_say(a: float, q: float, r: float, loss: float) -> None:
    """Also by Arnoldi's method; and where the fourth moment is infinite, a plain average says so."""
    plant, cost = Plant([[a]], [[1.0]], [[1.0]]), Cost([[q]], [[r]])
    loop = close(plant, design.all_time(plant, cost), Network("udp", actuator_loss=loss), cost)
    found, (two, four, _) = outcomes(loop), by_hand(a, q, r, loss)
    assert found is not None
    assert (found.growth(2), found.growth(4)) == (pytest.approx(two, rel=1e-9), pytest.approx(four, rel=1e-9))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "WHOLE", 1)
        assert (found.growth(2), found.growth(4)) == (pytest.approx(two, rel=1e-6), pytest.approx(four, rel=1e-6))
    assert two < 1 < four
    assert average(loop, steps=200_000).notes[0].startswith("the variance of the cost is infinite")


def test_a_loop_whose_mean_square_grows_is_refused() -> None:
    """A held input that does not fit does more harm than a lost packet: no outage alone explains it."""
    plant, cost = Plant([[1.05]], [[1.0]], [[1.0]]), Cost([[1.0]], [[0.01]])
    policy = design.all_time(plant, cost)
    assert by_hand(1.05, 1.0, 0.01, 0.34)[0] > 1 > 0.34 * 1.05**2
    with pytest.raises(
        UnstableError, match=r"with these losses, the mean square of its state grows by a factor of 1.05\d* per step"
    ):
        average(close(plant, policy, Network("udp", actuator_loss=0.34), cost), steps=200_000)
    event = close(plant, design.excess(plant, cost, theta=0.1), Network("udp", actuator_loss=0.34), cost)
    assert (
        average(event, steps=200_000)
        .notes[0]
        .startswith("with these losses the mean square would grow by a factor of 1.05")
    )


def test_bursts_turn_with_the_links() -> None:
    """Bursts without memory are losses without memory; two links turn together."""
    plant, cost = Plant([[1.1]], [[1.0]], [[1.0]]), Cost([[1.0]], [[0.5]])
    policy = design.all_time(plant, cost)

    def growth(network: Network) -> float:
        found = outcomes(close(plant, policy, network, cost))
        assert found is not None
        return found.growth(2)

    forgetful = Burst(to_bad=0.4, to_good=0.6, loss_good=0.1, loss_bad=0.6)
    assert growth(Network("udp", actuator_burst=forgetful)) == pytest.approx(
        growth(Network("udp", actuator_loss=0.6 * 0.1 + 0.4 * 0.6)), rel=1e-9
    )
    lasting = Burst(to_bad=0.04, to_good=0.06, loss_good=0.1, loss_bad=0.6)
    assert growth(Network("udp", actuator_burst=lasting)) > 1.02 * growth(Network("udp", actuator_burst=forgetful))
    assert outcomes(close(plant, policy, Network(), cost)) is None
    assert outcomes(taciturn.load("rover").close(taciturn.load("rover").design())) is None


@pytest.mark.parametrize("payload", ["float32", "int16"])
def test_an_operating_point_and_rounded_packets_change_no_moments(payload: str) -> None:
    """In the units of the plant every step adds a constant; the moments are those of the deviations."""
    link, point = {"payload": payload} | ({"actuator_range": 30.0} if payload == "int16" else {}), [[4.0], [-0.2]]
    plain = Plant([[1.05]], [[1.0]], [[1.0]])
    there = Plant([[1.05]], [[1.0]], [[1.0]], operating_point=OperatingPoint(*point))
    cost, loss = Cost([[1.0]], [[0.01]]), {"actuator_loss": 0.3}
    growths = []
    for plant, options in ((plain, {}), (there, link)):
        loop = close(plant, design.all_time(plant, cost), Network("udp", **loss, **options), cost)  # type: ignore[arg-type]
        found = outcomes(loop)
        assert found is not None
        growths.append((found.growth(2), found.growth(4)))
        assert average(loop, steps=20_000).notes[0].startswith("the variance of the cost is infinite")
    assert growths[0] == pytest.approx(growths[1], rel=1e-12)


@pytest.mark.parametrize("payload", ["float64", "float32", "int16"])
@pytest.mark.parametrize("name", ["two-mass", "pendulum-on-a-cart"])
def test_the_cost_of_attempts_is_that_of_the_linear_loop_with_exact_packets(name: str, payload: str) -> None:
    """Of any plant with any payload: around an operating point, nonlinear, with limits of the inputs."""
    problem = taciturn.load(name)
    plant, found = problem.plant, []
    ranges = {"sensor_range": 50.0, "actuator_range": 50.0} if payload == "int16" else {}
    network = Network("tcp", sensor_loss=0.02, actuator_loss=0.05, payload=payload, **ranges)  # type: ignore[arg-type]
    plain = Plant(plant.A, plant.B, plant.W, plant.C, plant.V, plant.dt)
    point = OperatingPoint(np.zeros(plant.states), np.zeros(plant.inputs))
    there = plant if plant.function else Plant(plant.A, plant.B, plant.W, plant.C, plant.V, operating_point=point)
    for one, net in ((plain, network.delivery), (there, network)):
        found.append(design.distributed(one, problem.cost, theta=0.3, network=net).cost_all_time)
    assert found[1] == pytest.approx(found[0], rel=1e-9)
