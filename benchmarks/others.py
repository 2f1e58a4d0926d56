"""The two-mass loop as users of other libraries write it: numba, JAX, python-control."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from taciturn.loop import Loop
from taciturn.model.steps import Assign
from taciturn_bench.bench import Contestant


class Data:
    """The matrices of the loop.

    Args:
        loop: the built-in problem, closed.
    """

    def __init__(self, loop: Loop) -> None:
        """Read them off plant and policy."""
        problem, plant, policy = loop.problem, loop.problem.plant, loop.policy
        steps = {step.signal: step.branches[0] for step in policy.steps if isinstance(step, Assign)}
        self.A, self.B, self.C, self.Q, self.R = plant.A, plant.B, plant.C, problem.Q, problem.R
        self.gain, self.L = np.asarray(steps["estimate"]["innovation"]), np.asarray(steps["command"]["estimate"])
        silent, send = policy.decisions["send"].options.values()
        self.Psi, self.gamma = np.asarray(silent.Psi), float(send.constant)
        self.W, self.V = np.linalg.cholesky(plant.W), np.linalg.cholesky(plant.V)
        assert policy.theory.innovations is not None
        assert policy.theory.identity is not None
        self.silence = float(np.asarray(policy.theory.identity.forms[0].Psi)[-1, -1])  # weight of the completed square
        self.driven = self.gain @ np.linalg.cholesky(policy.theory.innovations.covariance)


def numba_loop(data: Data) -> Contestant:
    """Return loops over paths and steps, compiled by numba, with its normals."""
    njit: Any = importlib.import_module("numba").njit
    A, B, C, Q, R, K, L = data.A, data.B[:, 0], data.C, data.Q, data.R[0, 0], data.gain, data.L[0]
    Psi, gamma, w, v = data.Psi, data.gamma, data.W[0, 0], data.V[0, 0]

    @njit(fastmath=True)
    def simulate(seed: int, paths: int, ticks: int) -> tuple[float, float]:
        np.random.seed(seed)
        cost, sends = 0.0, 0.0
        x, prior, estimate, z = np.zeros(4), np.zeros(4), np.zeros(4), np.zeros(6)
        moved, r = np.zeros(4), np.zeros(2)
        for _ in range(paths):
            x[:], prior[:], u = 0.0, 0.0, 0.0
            for _ in range(ticks):
                for i in range(2):
                    r[i] = v * np.random.standard_normal()
                    for j in range(4):
                        r[i] += C[i, j] * (x[j] - prior[j])
                command = 0.0
                for i in range(4):
                    estimate[i] = prior[i] + K[i, 0] * r[0] + K[i, 1] * r[1]
                    command += L[i] * estimate[i]
                    z[i] = estimate[i]
                z[4], z[5] = u, u - command
                form = 0.0
                for i in range(6):
                    for j in range(6):
                        form += z[i] * Psi[i, j] * z[j]
                if form > gamma:
                    u = command
                    sends += 1
                cost += R * u * u
                for i in range(4):
                    for j in range(4):
                        cost += x[i] * Q[i, j] * x[j]
                    moved[i] = B[i] * u + w * np.random.standard_normal()
                    prior[i] = B[i] * u
                    for j in range(4):
                        moved[i] += A[i, j] * x[j]
                        prior[i] += A[i, j] * estimate[j]
                x[:] = moved
        return cost, sends

    def run(seed: int) -> tuple[int, float]:
        paths, ticks = 100, 4000
        return paths * ticks, simulate(seed, paths, ticks)[1] / (paths * ticks)

    return run


def jax_scan(data: Data, form: str) -> Contestant:
    """Return a scan over steps of all paths side by side in doubles, normals drawn ahead for blocks of steps.

    The best of the variants that were tried: one vector of paths per signal, zeros and ones left out by hand. Matrix
    products in place of that were 1.4 times slower in the innovations form and 2.5 times in the full one; normals drawn
    within the scan 4 to 8 times.

    Args:
        data: the matrices.
        form: ``"full"``, with plant and filter, or ``"innovations"``.
    """
    jax: Any = importlib.import_module("jax")
    jnp: Any = importlib.import_module("jax.numpy")
    jax.config.update("jax_enable_x64", True)
    A, B, K, G, W, V, L = data.A, data.B[:, 0], data.gain, data.driven, data.W, data.V, data.L[0]
    stage, held, drift = float(data.Q[0, 0]), float(data.Psi[-1, -1]), float(data.Psi[0, 0])
    paths, block, blocks, many = 1024, 50, 32, 6 if form == "full" else 2

    def combine(row: Any, values: Any) -> Any:
        terms = [x if c == 1 else c * x for c, x in zip(row, values, strict=True) if c != 0]
        return sum(terms[1:], terms[0])

    def tick(carry: Any, n: Any) -> tuple[Any, None]:
        x, prior, u, cost, sends, excess = carry
        if form == "full":
            r = [x[i] + V[i, i] * n[i] - prior[i] for i in range(2)]
            estimate = [prior[i] + K[i, 0] * r[0] + K[i, 1] * r[1] for i in range(4)]
        else:
            estimate = [prior[i] + G[i, 0] * n[0] + G[i, 1] * n[1] for i in range(4)]
        command = combine(L, estimate)
        error = u - command
        sending = held * error**2 + drift * (sum(v * v for v in estimate) + u * u) > data.gamma
        excess = excess + jnp.where(sending, 0.0, data.silence * error**2)
        u = jnp.where(sending, command, u)
        seen = x if form == "full" else estimate
        cost = cost + stage * (sum(v * v for v in seen) + u * u)
        if form == "full":
            x = [combine(row, x) + b * u + W[i, i] * n[2 + i] for i, (row, b) in enumerate(zip(A, B, strict=True))]
        prior = [combine(row, estimate) + b * u for row, b in zip(A, B, strict=True)]
        return (x, prior, u, cost, sends + sending, excess), None

    def of_block(carry: Any, key: Any) -> tuple[Any, None]:
        return jax.lax.scan(tick, carry, jax.random.normal(key, (block, many, paths)))

    @jax.jit
    def simulate(key: Any) -> tuple[Any, ...]:
        zeros = jnp.zeros(paths)
        start = ([zeros] * 4, [zeros] * 4, zeros, zeros, zeros, zeros)
        carry, _ = jax.lax.scan(of_block, start, jax.random.split(key, blocks))
        return tuple(total.sum() for total in carry[3:])

    def run(seed: int) -> tuple[int, float]:
        steps = paths * block * blocks
        return steps, float(simulate(jax.random.PRNGKey(seed))[1]) / steps

    return run


def control_steps(data: Data) -> Contestant:
    """Return one path, step by step, through the systems of python-control."""
    control: Any = importlib.import_module("control")
    noise = np.hstack([data.B, data.W, np.zeros((4, 2))])
    plant = control.ss(data.A, noise, data.C, np.hstack([np.zeros((2, 5)), data.V]), 0.1)
    kept = data.A @ (np.eye(4) - data.gain @ data.C)
    observer = control.ss(kept, np.hstack([data.B, data.A @ data.gain]), np.eye(4), np.zeros((4, 3)), 0.1)

    def run(seed: int) -> tuple[int, float]:
        draws, ticks = np.random.default_rng(seed), 2000
        x, prior, u, sends = np.zeros(4), np.zeros(4), np.zeros(1), 0
        cost = 0.0
        for _ in range(ticks):
            drawn = draws.standard_normal(6)
            y = plant.output(0, x, np.concatenate([u, drawn]))
            estimate = prior + data.gain @ (y - data.C @ prior)
            command = data.L @ estimate
            z = np.concatenate([estimate, u, u - command])
            if z @ data.Psi @ z > data.gamma:
                u, sends = command, sends + 1
            cost += float(x @ data.Q @ x + u @ data.R @ u)
            x = plant.dynamics(0, x, np.concatenate([u, drawn]))
            prior = observer.dynamics(0, prior, np.concatenate([u, y]))
        return ticks, sends / ticks

    return run
