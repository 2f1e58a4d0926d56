"""Paths of loops whose links are late at random: what acts is what the queues of ``random_delays`` say, in every bit.

The delays of the packets of a path are those that the loop has drawn. By themselves they follow the law of the file.
"""

from __future__ import annotations

from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np
from everything.interpreters import SkippedError
from everything.random_delays import packets_of_a_path

from taciturn.loop import Loop
from taciturn.model.policy import Policy
from taciturn.model.steps import Send
from taciturn.problem import Problem
from taciturn.program.all_nodes import ACTING
from taciturn.program.draws import NORMAL
from taciturn.program.late import NEVER
from taciturn.program.machine import Kernel
from taciturn.program.ops import Arrived, Entry, Name, Sent, is_entry, named
from taciturn.program.translation import APPLIED, TimeStep
from taciturn.study.evaluation import Evaluation

STEPS = 2000
SURE = 5.5  # standard errors of a share of delays, of a handful in each problem


class Shown(TimeStep):
    """A time step that shows what is in its packets, when they arrive, and the inputs of the pieces of a period."""

    def packets(self) -> dict[Name, int]:
        """Return the flags of packets, their delays and contents, and the inputs."""
        found = super().packets() | self.delays() | named(ACTING, self.signals.get(ACTING, ()))
        for link in self.rings:
            for name in self.payloads[link]:
                found |= {
                    Entry(name, i, link): one
                    for i, one in enumerate(self.rounded(self.recall(name), self.payloads[link][name]))
                }
        return found


def same_queues(problem: Problem, found: Evaluation, seed: int, folder: Path) -> str | None:
    """Each input is that of the newest packet that has arrived; delays follow their law."""
    policy = problem.designed()
    if not isinstance(policy, Policy) or not problem.network.late:
        raise SkippedError("no delays that vary")
    loop = problem.close(policy)
    records, steps = recorded(loop, seed)
    for link in loop.network.late:
        sends = [step for step in loop.policy.steps if isinstance(step, Send) and step.link == link]
        if not sends:
            continue
        sent, codes = records[Sent(link)] > 0, records[Arrived(link, 0)]
        text = _by_law(loop, link, sent, codes) or _acts(loop, sends[0], sent, codes, records, steps)
        if text is not None:
            return text
    return None


def recorded(loop: Loop, seed: int) -> tuple[dict[Any, np.ndarray], int]:
    """Return what a path of a loop shows, (steps,) by name."""
    program = loop.in_units.whole_program(begin=Shown)
    program, draws = program.keep(outputs=set(program.outputs)), np.random.default_rng(seed)
    steps = min(STEPS, loop.horizon or STEPS)
    normal = np.array([is_entry(name, NORMAL) for name in program.inputs], dtype=bool)
    shape = steps, len(program.inputs), 1
    inputs = np.where(normal[:, None], draws.standard_normal(shape), draws.random(shape))
    outputs = Kernel(program, "parity").run(program, loop.start(program, 1, seed), steps, inputs).outputs
    return {name: values[:, 0] for name, values in outputs.items()}, steps


def _by_law(loop: Loop, link: str, sent: np.ndarray, codes: np.ndarray) -> str | None:
    """Compare the shares of delays with the law, if it is the same for each packet."""
    law, count = loop.network.random_delay(link, loop.policy.tick), int(sent.sum())
    assert law is not None
    if np.any(codes[~sent] < NEVER / 2):
        return f"a packet on {link} arrives that was not sent"
    if law.sequence or len(law.odds) > 1 or loop.network.burst(link) is not None or count < 100:
        return None
    pieces = loop.problem.pieces
    cuts = (0.0,) if pieces is None else pieces.cuts
    clocked = loop.network.nodes[link].measures is not False
    chances = dict[float, float]()
    for wait, p in zip(law.waits, law.odds[0], strict=True):
        whole = np.ceil(wait - 1e-9) if clocked else np.floor(wait + 1e-9)
        part = 0 if clocked else int(np.abs(np.array(cuts) - (wait - whole)).argmin())
        code = float(whole * len(cuts) + part)
        chances[code] = chances.get(code, 0.0) + p * (1 - loop.network.loss(link))
    shares = {code: float((codes[sent] == code).mean()) for code in chances}
    if not set(codes[sent & (codes < NEVER / 2)].tolist()) <= set(chances):
        return f"delays on {link} that its law does not have: {sorted(set(codes[sent].tolist()))}"
    wrong = [
        f"{code:g}: {shares[code]:.4f}, and not {p:.4f}"
        for code, p in chances.items()
        if abs(shares[code] - p) > SURE * sqrt(p * (1 - p) / count) + 1e-12
    ]
    return f"shares of the delays on {link}: {'; '.join(wrong)}" if wrong else None


def _acts(
    loop: Loop, step: Send, sent: np.ndarray, codes: np.ndarray, records: dict[Any, np.ndarray], steps: int
) -> str | None:
    """Compare the inputs of each piece with those in packets."""
    role, policy = loop.network.nodes[step.link], loop.in_units.policy
    if not role.applies or policy.model.saturation is not None or loop.problem.plant.saturation is not None:
        return None  # a controller hears the packets; limits change what acts
    pieces = loop.problem.pieces
    count = 1 if pieces is None else len(pieces.cuts)
    m = policy.model.inputs
    name = APPLIED if Entry(ACTING, 0) not in records else ACTING
    acting = np.array([records[Entry(name, i)] for i in range(m * (count if name == ACTING else 1))]).T
    acting = acting.reshape(steps, -1, m)
    (signal,) = step.payload
    ((_, rows),) = [one for one in policy.applied.values() if one[0] == step.link] or [(None, range(m))]
    values = np.array([records[Entry(signal, i, step.link)] for i in range(len(rows))]).T
    if values.shape[1] != len(rows):
        return None  # packets contain a state, from which the actuator computes
    newest = packets_of_a_path(sent.tolist(), codes.tolist(), count, NEVER / 2)
    first = acting[0, 0, list(rows)] if newest[0][0] < 0 else None
    for k in range(steps):
        for piece in range(acting.shape[1]):
            begun = newest[k][piece if acting.shape[1] == count else -1]
            wanted = first if begun < 0 else values[begun]
            if wanted is not None and acting[k, piece, list(rows)].tobytes() != np.asarray(wanted).tobytes():
                return f"{step.link}: in step {k}, piece {piece}, {acting[k, piece, list(rows)]} acts, and not {wanted}"
    return None
