"""Control variates: sums whose mean is known to be 0, and which explain most of what a mean over paths still varies by.

A normal n_i drawn in a tick is independent of what is remembered when the tick begins. So n_i s_j, for every state s_j,
and n_i n_j − [i = j] are martingale differences, and those of a quadratic value function are linear in them
[henderson2002].
"""

from __future__ import annotations

from dataclasses import replace

from taciturn.program.draws import NORMAL
from taciturn.program.ir import Program
from taciturn.program.ops import Op

CONTROL = "control"
MOST = 64  # controls: more would take longer than the rest of a tick


def with_controls(program: Program) -> Program:
    """Return the program with the controls among its sums; without them where they would be too many.

    Args:
        program: one tick, with inputs ``normal i``.
    """
    ops, sums = list(program.ops), dict(program.sums)
    normals = [i for i, op in enumerate(ops) if op.name == "input" and _is_normal(program.inputs[op.arguments[0]])]
    states = [i for i, op in enumerate(ops) if op.name == "state" and not program.states[op.arguments[0]].word]
    if len(normals) * (len(states) + (len(normals) + 1) / 2) > MOST:
        return program
    minus_one = len(ops)
    ops.append(Op("const", (len(program.constants),)))
    for k, normal in enumerate(normals):
        for index in states:
            ops.append(Op("mul", (normal, index)))
            state = program.states[ops[index].arguments[0]]
            sums[f"{CONTROL} {k} of {state.name} {state.index}"] = len(ops) - 1
        for m, other in enumerate(normals[k:], start=k):
            ops.append(Op("mul", (normal, other)))
            if m == k:
                ops.append(Op("add", (len(ops) - 1, minus_one)))
            sums[f"{CONTROL} {k} {m}"] = len(ops) - 1
    return replace(program, ops=tuple(ops), constants=(*program.constants, -1.0), sums=sums)


def controlled(program: Program, lean: Program) -> Program:
    """Return what was kept of a program, with the controls that are made of what it remembers."""
    remembered = {f"{state.name} {state.index}" for state in lean.states}
    controls = [name for name in program.sums if name.startswith(CONTROL)]
    fit = {name for name in controls if name.partition(" of ")[2] in {"", *remembered}}
    return program.keep({*lean.sums, *fit}, states={state.name for state in lean.states})


def _is_normal(name: str) -> bool:
    return name.split()[0] == NORMAL
