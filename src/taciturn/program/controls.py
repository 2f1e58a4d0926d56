"""Control variates for simulations: sums with mean 0 that explain most of the variance of a path's average cost.

A normal number n_i that is drawn in a step is independent of the states s_j at the start of the step. So n_i s_j and
n_i n_j − [i = j] have the conditional mean 0 given the past: they are martingale differences. Those of a quadratic
value function are linear combinations of them [henderson2002].
"""

from __future__ import annotations

from dataclasses import replace

from taciturn.program.draws import NORMAL
from taciturn.program.ir import Program
from taciturn.program.names import Control, Entry, is_entry
from taciturn.program.ops import Op

MOST = 64  # most controls; more would take longer than the rest of a step


def with_controls(program: Program) -> Program:
    """Return a simulation program with control variates as additional sums.

    If there were more than MOST of them, the program is returned unchanged.

    Args:
        program: one time step, with normal numbers among its inputs.
    """
    ops, sums = list(program.ops), dict(program.sums)
    normals = [
        i for i, op in enumerate(ops) if op.name == "input" and is_entry(program.inputs[op.arguments[0]], NORMAL)
    ]
    states = [i for i, op in enumerate(ops) if op.name == "state" and not program.states[op.arguments[0]].word]
    if len(normals) * (len(states) + (len(normals) + 1) / 2) > MOST:
        return program
    minus_one = len(ops)
    ops.append(Op("const", (len(program.constants),)))
    for k, normal in enumerate(normals):
        for index in states:
            ops.append(Op("mul", (normal, index)))
            state = program.states[ops[index].arguments[0]]
            sums[Control(k, Entry(state.name, state.index))] = len(ops) - 1
        for m, other in enumerate(normals[k:], start=k):
            ops.append(Op("mul", (normal, other)))
            if m == k:
                ops.append(Op("add", (len(ops) - 1, minus_one)))
            sums[Control(k, m)] = len(ops) - 1
    return replace(program, ops=tuple(ops), constants=(*program.constants, -1.0), sums=sums)


def controlled(program: Program, lean: Program) -> Program:
    """Return the reduced program ``lean`` with the control variates of ``program`` that use only states of ``lean``.

    Its states are those of ``lean``, entry by entry, so that a run may go on with it.
    """
    remembered = {Entry(state.name, state.index) for state in lean.states}
    controls = [name for name in program.sums if isinstance(name, Control)]
    fit = {name for name in controls if isinstance(name.other, int) or name.other in remembered}
    return program.keep({*lean.sums, *fit})
