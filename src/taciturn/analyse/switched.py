"""Closed loops as switched linear maps z⁺ = F_i z + G w, with the action i that minimises z'Ψ_i z + c_i."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, NoReturn

import numpy as np

from taciturn._arrays import Array, instance, symmetrised
from taciturn._modes import factor
from taciturn.analyse.reduction import Switched, reduce
from taciturn.errors import ProblemError
from taciturn.loop import COST, Loop
from taciturn.model.coverage import (
    BELLS,
    BURSTS,
    DRAWS,
    ENDING,
    EXOSYSTEM,
    FIRST,
    FUNCTION,
    FUNCTIONS,
    INTERVALS,
    JUMPS,
    LIMIT,
    LINEAR_LOOP,
    LOSSES,
    MEMORIES,
    ROUNDING,
    TRACKING,
    uncovered,
)
from taciturn.model.network import Network
from taciturn.model.policy import ONE, Apply, Condition, Decide, Draw, Evaluate, Policy, Send, Step
from taciturn.model.steps import read
from taciturn.model.trigger import Form, Matrix, Scheduled
from taciturn.program.draws import NORMAL
from taciturn.program.ir import Builder, Coefficient, Program
from taciturn.program.lower import TimeStep, Truth
from taciturn.program.names import Entry, Name, Named, Option, Sent, is_entry
from taciturn.program.quadratic import as_form, read_polynomials

SERVED = "expected linear steps and one trigger that compares quadratic forms, as in lqg, relative or consistent"

# the properties of a loop that its step represents, or refuses where it meets them (FixedStep)
CERTIFIED = (LINEAR_LOOP - EXOSYSTEM) | JUMPS | MEMORIES | BELLS | DRAWS


class Case(NamedTuple):
    """Decisions and losses: a label, the option that each decision takes, and the links that drop their packets."""

    label: str
    taken: Mapping[str, int]
    lost: Collection[str] = ()


def switched(loop: Loop) -> Switched:
    """Return the switched linear map of a closed loop, including its plant.

    z contains the plant's state, the memories of the nodes, and the measurement noise of the step. The reduction
    removes states that neither noise nor the initial state of the plant can reach. It also removes states that affect
    neither the cost nor a decision, such as the controller's copy of the held input.

    Args:
        loop: the closed loop; its plant may differ from that of the design.

    Returns:
        The map, the stage cost and the trigger.

    Raises:
        ProblemError: a step, a discrete state or the plant of the loop cannot be written in this form.

    Source: heemels2013

    Example:
        >>> from taciturn import Cost, Plant, close, design
        >>> plant, cost = Plant([[0.9]], [[1.0]], [[1.0]]), Cost([[1.0]], [[0.1]])
        >>> found = switched(close(plant, design.lqg(plant, cost, theta=0.2)))
        >>> found.labels, found.states, found.homogeneous
        (('silent', 'send'), 2, True)
    """
    instance("loop", loop, Loop)
    refuse_loops(loop)
    return reduce(*read_steps(loop, decisions_of(loop)))


def switched_innovations(loop: Loop) -> Switched:
    """Return the switched linear map of a closed loop in innovations form, where innovations drive the state estimate.

    The result has the same distribution as that of :func:`switched` if the plant is that of the design and the filter
    is in steady state. ``constant`` is tr(QΣ).

    Args:
        loop: the closed loop.

    Raises:
        ProblemError: the loop has no innovations form, or is not a switched linear map.

    Source: khashooei2017
    """
    instance("loop", loop, Loop)
    refuse_loops(loop)
    innovations = loop.policy.theory.innovations
    if not loop.reducible or innovations is None:
        raise ProblemError(
            "the loop has no innovations form: its plant, network or horizon is not that of the design; "
            "expected those of the design; for any other loop, use switched()"
        )
    return reduce(*read_steps(loop, decisions_of(loop), whole=False))


def decisions_of(loop: Loop) -> list[Case]:
    """Return the decisions of a step by label, without losses.

    Raises:
        ProblemError: the policy makes several decisions.
    """
    decisions = list(loop.policy.decisions.values())
    if len(decisions) > 1:
        raise ProblemError(f"{loop.policy.kind} makes {len(decisions)} decisions per step, {_unserved()}")
    if not decisions:
        return [Case("always", {})]
    ((name, trigger),) = loop.policy.decisions.items()
    return [Case(label, {name: option}) for option, label in enumerate(trigger.labels)]


def attempt_of(policy: Policy) -> Case | None:
    """Return the decisions under which a packet is sent on every link, or None if no option sends all of its links."""
    taken = dict[str, int]()
    for name, trigger in policy.decisions.items():
        sends = [step for step in policy.steps if isinstance(step, Send) and step.on == name]
        sending = [step.labels or trigger.labels[1:] for step in sends]
        options = [i for i, label in enumerate(trigger.labels) if all(label in labels for labels in sending)]
        if not options:
            return None
        taken[name] = options[0]
    return Case("every packet", taken)


def read_steps(loop: Loop, cases: Sequence[Case], whole: bool = True) -> tuple[Switched, Array]:
    """Return the step of a loop in each case, as maps of z = (states, noise that the step reads), and the initial z.

    The initial values are a column for each state of the plant, and one with those of all memories. Without ``whole``,
    the loop is in innovations form.

    Raises:
        ProblemError: the step is not linear.
    """
    plant, problem, innovations = loop.problem.plant, loop.problem, loop.policy.theory.innovations
    begins = [partial(FixedStep, loop.policy.kind, case) for case in cases]
    if whole or innovations is None:
        programs = [loop.whole_program(supplied=True, begin=begin) for begin in begins]
        name, read, moves, observed, hidden = "v", _factor(plant.V), _factor(plant.W), "x", 0.0
    else:
        programs = [loop.innovations_program(begin) for begin in begins]
        name, read, moves = NORMAL, np.eye(_factor(innovations.covariance).shape[1]), np.zeros((0, 0))
        observed, hidden = innovations.estimate, float(np.diag(innovations.error_covariance)[problem.moving].sum())
    states = len(programs[0].states)
    size, total = states + read.shape[1], states + read.shape[1] + moves.shape[1]
    unit = np.eye(total + 1)
    inputs: dict[Name, Array] = {Entry(name, i): row @ unit[states:size] for i, row in enumerate(read)}
    inputs |= {Entry("w", i): row @ unit[size:total] for i, row in enumerate(moves)}

    def square(value: Array) -> tuple[Array, float]:
        form = as_form(value)
        return symmetrised(form[:size, :size]), float(form[-1, -1])

    F, M, sending = list[Array](), list[tuple[Array, float]](), list[bool]()
    shown: dict[Name, Array] = {}
    for program in programs:
        values = read_polynomials(program, total, inputs)
        shown = {output: values[op] for output, op in program.outputs.items()}
        F.append(np.array([values[op] for op in program.following]))
        M.append(square(values[program.sums[COST]]))
        sending.append(all(shown[Sent(link)][-1] > 0 for link in loop.policy.scheduled))
    options = [square(value) for output, value in shown.items() if isinstance(output, Option)]
    X = np.array([row[:size] for output, row in shown.items() if is_entry(output, observed)])
    G = np.eye(size, total - states, total - size - states)  # the noise of the plant, then that of the next measurement
    G[:states, : total - size] = F[0][:, size:total]
    memories = [0.0 if isinstance(state.start, tuple) else state.start for state in programs[0].states]
    start = np.array([*memories, *[0.0] * (size - states)])[:, None]
    found = Switched(
        labels=tuple(case.label for case in cases),
        F=tuple(np.vstack([one[:, :size], np.zeros((size - states, size))]) for one in F),
        G=G,
        M=tuple(form for form, _ in M),
        Psi=tuple(form for form, _ in options) or (np.zeros((size, size)),),
        c=tuple(constant for _, constant in options) or (0.0,),
        X=X[problem.moving & ~problem.registers],
        constant=M[0][1],
        hidden=hidden,
        sends=sending.index(True) if any(sending) else None,
    )
    return found, np.hstack([X.T, start]) if whole else start


def _factor(covariance: Array) -> Array:
    return factor(covariance) if covariance.any() else np.zeros((len(covariance), 0))


class _Collected(Builder):
    """A builder whose program keeps all states, so that the programs of all actions have the same."""

    def finish(self, following: Sequence[int], sums: Named, outputs: Named | None = None) -> Program:
        return self.collect(following, sums, outputs or {})


class FixedStep(TimeStep):
    """The time step of a loop for a fixed decision and fixed arrivals; refuses what is not linear."""

    def __init__(self, kind: str, case: Case, builder: Builder, *rest: Any) -> None:
        """Keep the decisions of the case, and the name of the policy kind for messages."""
        super().__init__(_Collected(builder.precision), *rest)
        self._kind, self._case, self._option = kind, case, 0

    def draw_losses(self, policy: Policy, network: Network) -> None:
        """Draw nothing: the case lists the links that drop packets."""

    def take(self, step: Step) -> None:
        """Refuse steps that are not linear, and take the option of the case."""
        if isinstance(step, Evaluate | Apply | Draw):
            self._refuse(_beyond(step))
        if isinstance(step, Decide):
            self._option = self._case.taken[step.decision]
        super().take(step)

    def least(self, values: Sequence[int], allowed: Sequence[Truth]) -> list[Truth]:
        """Return the option of the case instead of the least one."""
        return [i == self._option for i in range(len(values) - 1)]

    def first_within(self, values: Sequence[int], limit: float, allowed: Sequence[Truth]) -> list[Truth]:
        """Return the option of the case instead of the first one within a limit."""
        return self.least(values, allowed)

    def arrives(self, link: str, sent: Truth) -> Truth:
        """Return whether a packet is sent, on a link that does not drop it in this case."""
        return sent and link not in self._case.lost

    def form(self, form: Form) -> int:
        """Refuse triggers that are not quadratic."""
        if form.bell is not None:
            self._refuse("triggers on the exponential of a quadratic form")
        if form.plus:
            self._refuse(f"triggers on {next(iter(form.plus))}")
        return super().form(form)

    def number(self, value: float | Scheduled) -> Coefficient:
        """Refuse constants that vary."""
        if isinstance(value, Scheduled):
            self._refuse(f"decides by the {value.by}")
        return super().number(value)

    def coefficients(self, matrix: Matrix) -> list[list[Coefficient]]:
        """Refuse matrices that vary."""
        if isinstance(matrix, Scheduled):
            if (matrix.values != matrix.values[0]).any():
                self._refuse(f"has matrices that vary with the {matrix.by}")
            matrix = matrix.values[0]
        return super().coefficients(matrix)

    def happened(self, condition: Condition) -> list[Truth]:
        """Refuse packets of the previous step."""
        if not isinstance(condition, str) and condition.link not in self.arrived:
            self._refuse("uses a packet of the previous step")
        return super().happened(condition)

    def _refuse(self, what: str) -> NoReturn:
        raise ProblemError(f"{self._kind} {what}, {_unserved()}")


def _beyond(step: Evaluate | Apply | Draw) -> str:
    """Return the reason why a step is not linear."""
    if isinstance(step, Draw):
        return "has a random threshold"
    if isinstance(step, Apply):
        return f"computes {', '.join(step.signals)} by a function"
    return f"stores {step.signal}, a quadratic form"


def refuse_loops(loop: Loop, more: frozenset[str] = frozenset()) -> None:
    """Raise an error if a loop is not a switched linear map over an infinite horizon.

    ``more`` are further properties that the caller supports.
    """
    policy = loop.policy
    missing = [name for name in uncovered(CERTIFIED, loop.parts) if name not in more]
    functions = [step for step in policy.steps if isinstance(step, Apply)]
    constants = any(ONE in read(step) for step in policy.steps)
    links = [link for link in loop.network.links if loop.network.loss(link) > 0]
    known = {
        "limits of the intervals between sends (min_interval, max_interval) are given": INTERVALS,
        "the plant is not linear": FUNCTION,
        "inputs are clipped (input_limit)": LIMIT & {"plant.input_limit"},
        "the changes of the inputs are limited (input_rate)": LIMIT & {"plant.input_rate"},
        f"{policy.kind} {_beyond(functions[0]) if functions else ''}": FUNCTIONS,
        f"{policy.kind} follows a reference": TRACKING,
        f"{policy.kind} adds constants": frozenset({ONE} if constants else ()),
        f"{policy.kind} decides on sets of links by a limit": FIRST,
        "the loop is a finite-horizon run, with a horizon or a discount": ENDING,
        "disturbances or set-points are given": EXOSYSTEM,
        f"the {links[0] if links else ''} link drops packets": LOSSES | BURSTS,
        f"packets contain rounded numbers ({loop.network.payload})": ROUNDING,
    }
    found = [text for text, names in known.items() if ONE in names or not names.isdisjoint(missing)]
    for text in (*found, *(f"{name} is given" for name in missing)):
        raise ProblemError(f"{text}, {_unserved()}")


def _unserved() -> str:
    return f"which certificates do not support; {SERVED}"
