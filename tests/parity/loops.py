"""What the parity tests share: loops to run, and what it means that two runs are the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from systems import System

from taciturn import Network, Policy, Trigger, close
from taciturn.loop import Loop
from taciturn.model.steps import Acknowledged, Apply, Assign, Decide, Draw, Evaluate, Location, Received, Send
from taciturn.model.trigger import Form, GaussianTerm, Scheduled
from taciturn.program import numpy as interpreter
from taciturn.program.ir import Program
from taciturn.program.machine import Kernel
from taciturn.program.numpy import Run
from taciturn.program.ops import Precision


def same(one: np.ndarray, other: np.ndarray) -> bool:
    """Tell whether two arrays of doubles hold the same bits."""
    return np.ascontiguousarray(one).tobytes() == np.ascontiguousarray(other).tobytes()


def differences(one: Run, other: Run) -> list[str]:
    """Return the names of what differs in a single bit."""
    kinds = ((one.sums, other.sums), (one.outputs, other.outputs))
    named = [name for left, right in kinds for name in left if not same(left[name], right[name])]
    return named if same(one.states, other.states) else ["states", *named]


def assert_parity(loop: Loop, program: Program, seed: int, paths: int = 11, ticks: int = 40) -> None:
    """Check that NumPy and the bit-exact build agree bit for bit."""
    states = loop.start(program, paths, seed)
    meaning = interpreter.run(program, states, ticks)
    assert all(np.isfinite(row).all() for row in meaning.outputs.values())
    assert differences(meaning, Kernel(program, "parity").run(program, states, ticks)) == []


def with_precision(loop: Loop, precision: Precision) -> Loop:
    """Return the loop in a precision; a discounted one stays in double."""
    return loop if loop.problem.cost.discount < 1 else replace(loop, precision=precision)


def programs(loop: Loop) -> list[Program]:
    """Return the loop with its plant, and without where that holds."""
    return [loop.program(), loop.reduced_program()] if loop.reducible else [loop.program()]


def every_feature(system: System, seed: int) -> Loop:
    """Return a loop with losses on both links, a clock, a location that decisions move, a memory, a draw, a bell, three
    labels.

    The numbers are random: nothing is claimed of this policy but that it is one.
    """
    plant, draws = system.plant, np.random.default_rng(seed)
    n, m, p = plant.states, plant.inputs, plant.outputs
    told = bool(draws.integers(2))
    network = Network("tcp" if told else "udp", float(draws.uniform(0, 0.6)), float(draws.uniform(0, 0.6)))

    def square(size: int, scale: float) -> np.ndarray:
        G = scale * draws.normal(size=(size, size)) * (draws.random((size, size)) < 0.6)
        return G + G.T

    gain, unit = 0.3 * draws.normal(size=(n, p)), np.eye(n)
    L = 0.2 * draws.normal(size=(3, m, n)) * draws.integers(0, 2, (m, n))  # zeros shared by all phases, and others
    L[1] = np.where(draws.random((m, n)) < 0.5, L[0], L[1])
    Psi = np.array([square(n + m, 0.3) for _ in range(2)])
    clock = Location("clock", np.array([1, 2, 0]), initial=int(draws.integers(3)))
    mood = Location("mood", draws.integers(0, 2, (2, 3)), at="controller", on="send")
    heard = Location("heard", np.array([[0, 1], [0, 1]]), at="actuator", on=Received("actuator"))
    bell = GaussianTerm(-0.4, np.eye(m) + 0.5)
    trigger = Trigger({
        "silent": Form(("estimate", "error"), Scheduled("mood", Psi), plus={"spent": 0.1}),
        "short": Form(("error",), square(m, 0.2), Scheduled("clock", draws.uniform(0, 1, 3))),
        "full": Form(("error",), plus={"luck": 2.0, "spent": -0.05}, constant=0.3, bell=bell),
    })  # fmt: skip
    spent = (Form(("error",), square(m, 0.1), plus={"spent": 0.5}), Form(plus={"spent": 0.25}), Form(constant=1.0))
    kept, command = {"held": 0.9 * np.eye(m)}, {"command": np.eye(m)}
    noted = ((kept, command), Acknowledged("actuator")) if told else ((kept, kept, command), "send")
    corrected = {"prior": unit - gain @ plant.C, "y": gain}
    faded = {"input": Scheduled("heard", np.array([0.5, 0.9])[:, None, None] * np.eye(m))}
    steps = (
        Send("sensor", "sensor", ("y",)),
        Assign("controller", "estimate", ({"prior": unit}, corrected), Received("sensor")),
        Assign("controller", "command", {"estimate": Scheduled("clock", L)}),
        Assign("controller", "error", {"command": np.eye(m), "held": -np.eye(m)}),
        Draw("controller", "luck"),
        Decide("controller", "send", trigger),
        Send("controller", "actuator", ("command",), "send", ("full",) if draws.integers(2) else ()),
        Evaluate("controller", "spent", spent, "send"),
        Assign("actuator", "input", (faded, command), Received("actuator")),
        Assign("controller", "held", *noted),
        Assign("controller", "prior", {"estimate": plant.A, "held": plant.B}),
    )
    policy = Policy("every feature", steps, plant, locations=(clock, mood, heard), network=network)
    return close(plant, policy, network, system.cost)


def with_functions(system: System, seed: int, protocol: str = "udp") -> Loop:
    """Return a loop with an extended Kalman filter, a trigger and an input that are functions, over links that lose.

    Its model is not the plant's: nothing is claimed of this policy but that it is one.
    """
    plant, draws = system.plant, np.random.default_rng(seed)
    A, B, C, n, p = plant.A, plant.B, plant.C, plant.states, plant.outputs
    noise, L, unit = plant.V + 0.1 * np.eye(p), 0.2 * draws.normal(size=(plant.inputs, n)), np.eye(plant.inputs)
    loss = 0.0 if protocol == "ideal" else 0.3

    def correct(forecast: np.ndarray, spread: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        P = spread.reshape(n, n)
        K = np.linalg.solve(C @ P @ C.T + noise, C @ P).T
        return forecast + K @ (y - C @ forecast), (P - K @ C @ P).ravel()

    def predict(estimate: np.ndarray, covariance: np.ndarray, held: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        bent = np.clip(estimate, -3.0, 3.0)
        F = A + 0.1 * np.diag(np.where(np.abs(estimate) < 3.0, np.cos(bent), 0.0))
        spread = np.zeros((n, n))
        spread += F @ covariance.reshape(n, n) @ F.T / (1.0 + covariance @ covariance) + plant.W
        return A @ estimate + B @ held + 0.1 * np.sin(bent), spread.ravel()

    def urge(error: np.ndarray, estimate: np.ndarray) -> np.ndarray:
        size = np.log(1.0 + np.linalg.norm(error)) - 0.2 * np.arctan2(estimate[0], 1.0)
        return np.maximum(size, np.sqrt(np.abs(error[0])) - 1.0) / (1.0 + np.exp(-np.abs(estimate).sum()))

    def bound(aim: np.ndarray) -> np.ndarray:
        return 4.0 * np.tanh(aim / 4.0)

    steps = (
        Apply("controller", {"estimate": n, "covariance": n * n}, correct, ("forecast", "spread", "y")),
        Assign("controller", "command", {"estimate": L}),
        Assign("controller", "error", {"command": unit, "held": -unit}),
        Apply("controller", {"urge": 1}, urge, ("error", "estimate")),
        Decide("controller", "send", Trigger({"silent": Form(plus={"urge": 1.0}), "send": Form()})),
        Send("controller", "actuator", ("command",), "send"),
        Assign("actuator", "aim", ({"aim": 0.9 * unit}, {"command": unit}), Received("actuator")),
        Apply("actuator", {"input": plant.inputs}, bound, ("aim",)),
        Assign("controller", "held", ({"held": unit}, {"command": unit}), "send"),
        Apply("controller", {"forecast": n, "spread": n * n}, predict, ("estimate", "covariance", "held")),
    )
    place, network = frozenset({"sensor", "controller"}), Network(protocol, loss)  # type: ignore[arg-type]
    first = {"spread": np.eye(n).ravel()}
    policy = Policy("functions", steps, plant, sites=(place,), initial=first, network=network)  # type: ignore[arg-type]
    return close(plant, policy, network, system.cost)
