"""Start values of a policy's nodes in a loop of one's own: an initial estimate, and a start without a jump."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from taciturn._arrays import Array, ArrayLike, array
from taciturn.errors import ProblemError
from taciturn.model.network import REFERENCE, Network
from taciturn.model.policy import Policy
from taciturn.model.steps import ONE
from taciturn.program.controller import MEASURED, TOLD, fate_of, lower_command, predicted_outputs
from taciturn.program.names import Entry, Name
from taciturn.program.python import compile_python

HELD = "held"  # name, or its beginning, of the copy of an actuator's input at another node
NEAR = 1e-9  # relative difference of two inputs
TRIES = 4


def started(
    policy: Policy, network: Network, estimate: ArrayLike | None, start_input: ArrayLike | None
) -> tuple[Policy, tuple[str, ...]]:
    """Return a policy whose nodes start from an estimate of the state, or from an input, and remarks on this start.

    Args:
        policy: the policy.
        network: the network between the nodes.
        estimate: estimate of the state before the first measurement, (n,); default: the mean of the problem.
        start_input: input of the plant before the first step, (m,); default: that of the policy.

    Raises:
        ProblemError: the commands of the policy do not depend on the estimate of a filter, or the sizes differ.
    """
    if estimate is not None:
        n = policy.model.states
        wanted = array("estimate", estimate, (n,), "(states,), those of disturbances and set-points included")
        policy = _from_estimate(policy, network, wanted)
    if start_input is None:
        return policy, ()
    u, limit = array("start_input", start_input, (policy.model.inputs,), "(inputs,)"), policy.model.input_limit
    if limit is not None and ((u < limit[:, 0]) | (u > limit[:, 1])).any():
        raise ProblemError(
            f"start_input is {u.tolist()}, beyond the input_limit {limit.tolist()}; expected an input within the limits"
        )
    return _from_input(policy, network, u)


def _from_estimate(policy: Policy, network: Network, estimate: Array) -> Policy:
    prior, n = _prior(policy), policy.model.states
    before = _command(policy, network, measured=True)
    if prior and before is not None:
        moved = np.sqrt(2.0 + np.arange(n)) - policy.model.mean  # a direction in which no gain vanishes by chance
        after = _command(_shifted(policy, prior, moved), network, measured=True)
        if after is not None and not np.array_equal(before, after):
            return _shifted(policy, prior, estimate - policy.model.mean)
    raise ProblemError(
        f"estimate is given, but the commands of this {policy.kind} do not follow from a filter's estimate; expected a "
        "policy whose controller filters measurements with noise, or no estimate"
    )


def _from_input(policy: Policy, network: Network, u: Array) -> tuple[Policy, tuple[str, ...]]:
    """Return the policy that starts with an input, with the constant disturbances for which this is the command."""
    model, memories = policy.model, dict(policy.initial)
    if policy.tracking is not None or policy.disturbance is not None:
        raise ProblemError(
            f"start_input is given, but this {policy.kind} keeps a given controller or follows a stored reference; "
            "expected start_input of the controller ([controller] pid), or no start_input"
        )
    for signal, (node, rows) in policy.applied.items():
        copies = dict.fromkeys((signal, f"{HELD}_{node}"))  # in one order: fingerprints contain the start values
        memories |= {name: u[[*rows]] for name in copies if name in policy.sizes}
    if HELD in policy.sizes:
        memories[HELD] = u
    policy, prior = replace(policy, initial=memories), _prior(policy)
    unknown, scale = _constants(policy) if prior else [], NEAR * max(1.0, float(np.abs(u).max()))
    found = _command(policy, network)
    for _ in range(TRIES if unknown else 0):  # one suffices, unless the packets of sensors change
        if found is None or np.abs(found - u).max() <= scale:
            break
        units = [_command(_shifted(policy, prior, unit), network) for unit in np.eye(model.states)[unknown]]
        effect = np.array([found if one is None else one - found for one in units]).T
        moved = np.zeros(model.states)
        moved[unknown] = np.linalg.lstsq(effect, u - found, rcond=None)[0]
        policy = _shifted(policy, prior, moved)
        found = _command(policy, network)
    if found is not None and np.abs(found - u).max() <= scale:
        return policy, ()
    got = "depends on the first measurement" if found is None else f"is {found.round(6).tolist()}"
    return policy, (
        f"the model has no constant disturbances that account for start_input, so the first command {got}; only "
        "inputs that are held start at start_input",
    )


def _prior(policy: Policy) -> str:
    """Return the name of the predicted state in the filter of a policy, or an empty name."""
    predicted, C = predicted_outputs(policy) or {}, policy.model.C
    found = [name for name, weight in predicted.items() if name != ONE and np.array_equal(np.asarray(weight), C)]
    return found[0] if found else ""


def _constants(policy: Policy) -> list[int]:
    """Return the indices of the states that are unknown constants, as neither inputs nor other states move them.

    A state that moves another state of this kind is no constant disturbance, but for example the slope of a ramp.
    """
    A, B, W = policy.model.A, policy.model.B, policy.model.W
    apart = ~B.any(axis=1)
    while (moved := apart & A[:, ~apart].any(axis=1)).any():  # by a state that inputs move
        apart &= ~moved
    unit = np.eye(len(A))
    return [
        int(i)
        for i in np.flatnonzero(apart)
        if np.array_equal(A[i], unit[i]) and np.array_equal(A[apart, i], unit[apart, i]) and W[i, i]
    ]


def _shifted(policy: Policy, prior: str, moved: Array) -> Policy:
    """Return the policy whose first prediction of the state is changed by a vector."""
    start = policy.initial.get(prior, np.zeros(policy.model.states))
    return replace(policy, initial={**policy.initial, prior: start + moved})


def _command(policy: Policy, network: Network, measured: bool = False) -> Array | None:
    """Return the first command if all outputs are as predicted or are measured as 0, or None if this is not known.

    Packets arrive, and the draws of the policy do not matter to a command.
    """
    program = None if predicted_outputs(policy) is None else lower_command(policy, network)
    if program is None:
        return None
    given: dict[Name, float] = {Entry(fate_of(link), 0): 1.0 for link in network.links}
    given[Entry(TOLD, 0)] = 0.0
    outputs = range(policy.model.sensed)
    given |= {Entry(REFERENCE, i): value for i, value in enumerate(policy.model.given.tolist())}
    given |= {Entry(name, i): value for name, value in (("y", 0.0), (MEASURED, float(measured))) for i in outputs}
    start: list[float] = [0.0 if isinstance(state.start, tuple) else state.start for state in program.states]
    values = compile_python(program)(start, [given.get(name, 0.5) for name in program.inputs])[1]
    return np.array(values) + 0.0
