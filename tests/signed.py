"""Everything that identifies a problem, a policy or its code, as digests: ``python tests/signed.py [--all]``.

Prints JSON: for each problem the digest of its data, the fingerprint of its policy, the digests of the description of
its packets, of the program of its loop and of its nodes in C, and the token of its co-simulation unit. With ``--all``
it does so for a problem of each kind and the built-in ones. They must be the same in every process, whatever the seed
of its hashes.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Iterator
from typing import Any

from used import KINDS

from taciturn._plugins import problem_folders
from taciturn.errors import TaciturnError
from taciturn.loop import Loop
from taciturn.model.packets import fingerprint, roles
from taciturn.nodes.description import describe_wire
from taciturn.problem import Problem, load, parse
from taciturn.study.record import fingerprint as digest_of_problem
from taciturn_export.fmu import print_fmu
from taciturn_export.node import print_node

MATRICES: dict[str, Any] = {
    "plant": {
        "A": [[1.0, 0.1], [0.0, 0.9]], "B": [[0.0], [0.1]], "C": [[1.0, 0.0]],
        "W": [[1e-4, 0.0], [0.0, 4e-4]], "V": [[1e-3]], "dt": 0.1,
    },
    "cost": {"Q": [[1.0, 0.0], [0.0, 0.0]], "R": [[0.05]]},
}  # fmt: skip
TANK: dict[str, Any] = MATRICES | {
    "reference": {"value": [3.0], "steps": {"rate": 0.01, "covariance": [[4.0]]}},
    "nodes": {"probe": {"measures": True}, "box": {"controls": True}, "valve": {"applies": True}},
    "links": {"probe": {"max_interval": 20}},
    "policy": {"kind": "distributed", "theta": 0.5},
}
PID: dict[str, Any] = MATRICES | {
    "controller": {"pid": {"kp": 1.2, "ki": 0.15, "kd": 1.0, "filter": 0.5, "start_input": 0.4}},
    "policy": {"kind": "excess", "theta": 0.1},
}


def problems(every: bool) -> Iterator[tuple[str, Problem]]:
    """Yield the problems by name."""
    yield from (("pid", parse(PID, "pid")), ("tank", parse(TANK, "tank")))
    if every:
        yield from KINDS.items()
        yield from ((file.stem, load(file)) for folder in problem_folders() for file in sorted(folder.glob("*.toml")))


def signed(problem: Problem) -> dict[str, str]:
    """Return what identifies a problem and what is made of it; in place of what cannot be made the reason."""
    found = {"problem": digest_of_problem(problem)}
    try:
        texts = _texts(problem.close(problem.design()))
    except TaciturnError as error:
        return found | {"policy": str(error)}
    for name, text in texts.items():
        try:
            found[name] = hashlib.sha256(text().encode()).hexdigest()
        except TaciturnError as error:
            found[name] = str(error)
    return found


def _texts(loop: Loop) -> dict[str, Callable[[], str]]:
    policy, network = loop.policy, loop.network

    def in_c() -> str:
        nodes = (print_node(policy, role, network, "node") for role in roles(policy))
        return "".join(node.header + node.source for node in nodes)

    return {
        "policy": lambda: f"{fingerprint(policy, network):016x}",
        "packets": lambda: json.dumps(describe_wire(policy, network)),
        "loop": lambda: repr((program := loop.open_program()).ops) + repr((program.states, list(program.outputs))),
        "nodes in C": in_c,
        "unit": lambda: print_fmu(loop, "unit", compiler=None).token,
    }


if __name__ == "__main__":
    print(json.dumps({name: signed(one) for name, one in problems("--all" in sys.argv[1:])}, indent=1))
