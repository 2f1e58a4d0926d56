"""Closed loops as switched linear maps z⁺ = F_i z + G w: the action i is the one that minimises z'Ψ_i z + c_i.

The program of a step is interpreted with linear values ℓ'z and quadratic ones z'Hz (``program.quadratic``), once for
each action: with the decision fixed, a step has no branches. So the matrices F_i, the stage cost z'M_i z and the forms
of the trigger are those of the program that is simulated. The map is reduced to its reachable and observable states,
scaled to about unit size, for certificates. In innovations form it has the same distribution if the plant is that of
the design and the filter is steady. Two questions are answered without simulation.

**Moments over lossy links and with missing samples** (``outcomes``). The map is then z⁺ = F_o z + G w, where the
outcome o lists the links that drop a packet, and the nodes whose samples are missing. The probability of an outcome
depends only on the state of the links and sensors. Therefore the second and the fourth moments of z satisfy linear
recursions, and exist in the long run only if these are stable. Let X_s be the second moment in state s, T the
transition probabilities of the states, and π_r the share of the steps in state r. Then

    X_s⁺ = Σ_r T_rs Σ_o p(o | r) (F_o X_r F_o' + π_r G G').

For the fourth moment F_o acts on all four indices.

**Signals that wander** (``drifting``). Disturbances and set-points may wander without limit, and then a link whose
decisions depend on them has no average rate. Let d⁺ = Sd be these signals, and let every link send in every step. Then
the loop is linear, and all its other states approach the response z = Πd that satisfies

    F_zz Π + F_zd = Π S.

A trigger compares quadratic forms. Let η be the rows of their difference. If η(Π, I)d does not forget the noise that
moves d, the difference grows without limit although everything is sent: the longer the loop has run, the more the
decision depends on the size of d alone. Its rate then has no average below its limit, which is usually to send every
sample.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import compress
from typing import Any, NamedTuple, NoReturn

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array, instance, pushed, symmetrised
from taciturn._display import Displayed
from taciturn._modes import balancing, factor, growth, invariant, normal_moments, radius, unit_columns
from taciturn._progress import check_time
from taciturn.errors import ProblemError, UnstableError
from taciturn.loop import COST, Loop
from taciturn.lqg.followed import CANCELS
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
    SAMPLES,
    TRACKING,
    uncovered,
)
from taciturn.model.link import IDEAL_LINK
from taciturn.model.losses import together
from taciturn.model.network import Network
from taciturn.model.policy import Policy
from taciturn.model.steps import ONE, Apply, Condition, Decide, Draw, Evaluate, Send, Step, read
from taciturn.model.trigger import Form, Matrix, Scheduled, Trigger
from taciturn.program.draws import NORMAL
from taciturn.program.ir import Builder, Coefficient, Program, Truth
from taciturn.program.ops import Entry, Name, Named, Option, Sent, is_entry
from taciturn.program.quadratic import as_form, read_polynomials
from taciturn.program.translation import TimeStep

# the properties of a loop that its step represents, or refuses where it meets them (FixedStep)
CERTIFIED = (LINEAR_LOOP - EXOSYSTEM) | JUMPS | MEMORIES | BELLS | DRAWS
SERVED = "expected linear steps and one trigger that compares quadratic forms, as in lqg, relative or consistent"

# the run that measures the size of the coordinates
PATHS, TICKS, DROPPED = 32, 600, 100  # paths, steps and discarded steps
FORCED = 0.2  # share of its steps that take the last action, so that rarely sent signals are measured too
HUGE = 1e100  # beyond this size the run has diverged
BLUR = 1e-9  # least eigenvalue of the correlation matrix that is used

# the moments over lossy links
MOST_MOMENTS = 100_000  # largest number of fourth moments, times the outcomes, for which their growth is computed
SOLVED = 1e-9  # relative residual of the equation for the second moments
NEARLY = 1e-9  # distance to a growth of 1 within which the second moments count as divergent
MOST_LAWS = 6  # largest number of links that drop packets and of nodes that miss samples, with 2^number outcomes
WHOLE = 400  # largest number of rows of a recursion matrix that is stored as a dense matrix

# the response to signals that wander
MOST_ENTRIES = 4000  # entries of Π for which the equations are solved
RANK = 1e-12  # eigenvalue of a form, or entry of its rows, relative to the largest, that is a rounding error


@dataclass(frozen=True, eq=False, repr=False)
class Switched(Displayed):
    """A closed loop as a switched linear map, with its cost and trigger. The coordinates z have about unit variance."""

    labels: tuple[str, ...]  # names of the actions
    F: tuple[Array, ...]  # dynamics matrix of each action, (r, r)
    G: Array  # input matrix of the noise w of a step, (r, q): plant noise, then the next measurement's, unit covariance
    M: tuple[Array, ...]  # cost matrix of each action, (r, r): the stage cost of a step is z'M_i z + ``constant``
    Psi: tuple[Array, ...]  # trigger matrix of each action, (r, r)
    c: tuple[float, ...]  # trigger constant of each action
    X: Array  # matrix (n, r) such that X z is the plant's state; in the innovations form, X z is the estimate
    constant: float  # cost of every step in addition to z'M_i z
    hidden: float  # mean square of the part of the plant's state that X z excludes
    sends: int | None  # the action under which every link that the policy decides on sends, or None

    @property
    def homogeneous(self) -> bool:
        """Whether all constants c_i are equal, so that the send decision depends only on the direction of z."""
        return len(set(self.c)) == 1

    @property
    def states(self) -> int:
        """Number of entries of the state z."""
        return len(self.G)

    def margins(self, action: int) -> list[tuple[Array, float]]:
        """Return (D, d) for every other action: the loop takes the given action if all conditions z'Dz + d ≥ 0 hold."""
        own, others = action, [j for j in range(len(self.labels)) if j != action]
        return [(self.Psi[j] - self.Psi[own], self.c[j] - self.c[own]) for j in others]

    def under(self, action: int) -> Switched:
        """Return the map of the loop when it takes the given action at every step."""
        label, F, M, nothing = self.labels[action], self.F[action], self.M[action], np.zeros_like(self.Psi[action])
        return replace(self, labels=(label,), F=(F,), M=(M,), Psi=(nothing,), c=(0.0,), sends=0)

    def changed(self, inverse: Array, T: Array) -> Switched:
        """Transform this map to the coordinates y defined by z = T y, given T and its inverse."""
        return replace(
            self,
            F=tuple(inverse @ F @ T for F in self.F),
            G=inverse @ self.G,
            M=tuple(symmetrised(T.T @ M @ T) for M in self.M),
            Psi=tuple(symmetrised(T.T @ Psi @ T) for Psi in self.Psi),
            X=self.X @ T,
        )


def reduce_states(raw: Switched, starts: Array) -> Switched:
    """Transform a switched linear map to as few coordinates as possible, each scaled to about unit variance."""
    # a certificate does not depend on the scaling; unit size makes the solver more accurate
    found = relevant(raw, starts)
    T = _sizes(found)
    return found.changed(np.asarray(np.linalg.inv(T), dtype=np.float64), T)


def relevant(raw: Switched, starts: Array) -> Switched:
    """Remove states that neither noise nor initial states excite, and states that affect neither cost nor trigger."""
    # these are the states that the initial columns or the noise reach, and that the rows, the cost or the trigger show
    sizes = balancing(sum((np.abs(F) for F in raw.F), np.zeros_like(raw.F[0])))
    found = raw.changed(np.diag(1 / sizes), np.diag(sizes))
    reached = invariant(np.column_stack([unit_columns(found.G), unit_columns(starts / sizes[:, None])]), found.F)
    found = found.changed(reached.T, reached)
    differences = [Psi - found.Psi[0] for Psi in found.Psi[1:]]
    sizes = [np.abs(each).max(initial=0.0) or 1.0 for each in (*found.M, *differences)]
    shown = [each / size for each, size in zip((*found.M, *differences), sizes, strict=True)]
    rows = np.vstack([unit_columns(found.X.T).T, *shown])
    seen = invariant(rows.T, [F.T for F in found.F])
    return found.changed(seen.T, seen)


def _sizes(found: Switched) -> Array:
    """Return T such that T T' is approximately the covariance of the coordinates, measured in a short run."""
    draws, states = np.random.default_rng(0), len(found.G)
    z, total, kept = np.zeros((states, PATHS)), np.zeros((states, states)), 0
    with np.errstate(all="ignore"):
        for tick in range(TICKS):
            values = [np.einsum("ip,ij,jp->p", z, Psi, z) + own for Psi, own in zip(found.Psi, found.c, strict=True)]
            action = np.where(draws.random(PATHS) < FORCED, len(found.c) - 1, np.argmin(values, axis=0))
            z = np.choose(action, [F @ z for F in found.F]) + found.G @ draws.standard_normal((found.G.shape[1], PATHS))
            if not np.abs(z).max(initial=0.0) < HUGE:
                return np.eye(states)
            if tick >= DROPPED:
                total, kept = total + z @ z.T, kept + PATHS
    covariance = total / kept
    largest = float(np.diag(covariance).max(initial=0.0))
    if largest == 0:  # no noise
        return np.eye(states)
    if not (np.diag(covariance) > 1e-12 * largest).all():  # noise that does not reach all coordinates
        covariance = covariance + 1e-4 * largest * np.eye(states)
    # with the correlation matrix VΛV' and the deviations D, T = D V √Λ has T T' = the covariance
    size = np.sqrt(np.diag(covariance))
    correlation = symmetrised(covariance / size / size[:, None])
    values, vectors = np.linalg.eigh(correlation)
    return size[:, None] * vectors * np.sqrt(np.maximum(values, BLUR))


class Case(NamedTuple):
    """One case of a step: the label that each decision selects, the links that drop their packets, and the nodes whose
    samples are missing.
    """

    label: str
    taken: Mapping[str, int]
    lost: Collection[str] = ()
    missing: Collection[str] = ()


def switched(loop: Loop) -> Switched:
    """Convert a closed loop, including its plant, to a switched linear map."""
    # z contains the plant's state, the memories of the nodes, and the measurement noise of the step. The reduction
    # removes states without effect, such as the controller's copy of the held input.
    instance("loop", loop, Loop)
    refuse_loops(loop)
    return reduce_states(*read_steps(loop, decisions_of(loop)))


def switched_innovations(loop: Loop) -> Switched:
    """Convert a closed loop, driven by the filter's innovations, to a switched linear map; ``constant`` is tr(QΣ)."""
    instance("loop", loop, Loop)
    refuse_loops(loop)
    innovations = loop.policy.theory.innovations
    if not loop.reducible or innovations is None:
        raise ProblemError(
            "the loop has no innovations form: its plant, network or horizon is not that of the design; expected the "
            "plant, network and horizon of the design: for another loop, use switched()"
        )
    return reduce_states(*read_steps(loop, decisions_of(loop), whole=False))


def decisions_of(loop: Loop) -> list[Case]:
    """List the labels that the loop's decision can select in a step, each as a case in which no packet is dropped."""
    decisions = list(loop.policy.decisions.values())
    if len(decisions) > 1:
        raise ProblemError(
            f"the policy {loop.policy.kind} makes {len(decisions)} send decisions per step, {_unserved()}"
        )
    if not decisions:
        return [Case("always", {})]
    ((name, trigger),) = loop.policy.decisions.items()
    return [Case(label, {name: option}) for option, label in enumerate(trigger.labels)]


def attempt_of(policy: Policy) -> Case | None:
    """Return the case in which every link sends a packet; None if a decision cannot select sending on all its links."""
    taken = dict[str, int]()
    for name, trigger in policy.decisions.items():
        sends = [step for step in policy.steps if isinstance(step, Send) and step.on == name]
        sending = [step.sending(trigger.labels) for step in sends]
        options = [i for i, label in enumerate(trigger.labels) if all(label in labels for labels in sending)]
        if not options:
            return None
        taken[name] = options[0]
    return Case("every packet", taken)


def read_steps(loop: Loop, cases: Sequence[Case], whole: bool = True) -> tuple[Switched, Array]:
    """Compute for each case the linear map of z = (states, noise of the step). Also return initial values of z."""
    # The initial values are a column for each state of the plant, and one with those of all memories. Without
    # ``whole``, the loop is in innovations form.
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
    """Time step of a loop for given decisions and packet arrivals. Raises an error if a policy step is not linear."""

    def __init__(self, kind: str, case: Case, builder: Builder, *rest: Any) -> None:
        """Keep the decisions of the case, and the name of the policy kind for messages."""
        super().__init__(_Collected(builder.precision), *rest)
        self._kind, self._case, self._option = kind, case, 0

    def draw_losses(self, policy: Policy, network: Network, cuts: tuple[float, ...] = (0.0,)) -> None:
        """Draw no random losses, because the case states which links drop their packets."""

    def draw_samples(self, network: Network) -> dict[str, Truth]:
        """Return which nodes have a sample: all but those that the case lists."""
        return {node: node not in self._case.missing for node in network.missing}

    def take(self, step: Step) -> None:
        """Translate a policy step for the label of the case; raise an error if the policy step is not linear."""
        if isinstance(step, Evaluate | Apply | Draw):
            self._refuse(_beyond(step))
        if isinstance(step, Decide):
            self._option = self._case.taken[step.decision]
        super().take(step)

    def chosen(self, trigger: Trigger, values: Sequence[int]) -> list[Truth]:
        """Return, for each label of a decision, whether the case states it; the forms of the trigger do not matter."""
        return [i == self._option for i in range(len(values) - 1)]

    def arrives(self, link: str, sent: Truth) -> Truth:
        """Return whether a packet arrives: it is sent, and the case does not list its link as dropping packets."""
        return sent and link not in self._case.lost

    def form(self, form: Form) -> int:
        """Translate a form of a trigger; raise an error if the form is not purely quadratic."""
        if form.bell is not None:
            self._refuse("triggers on the exponential of a quadratic form")
        if form.plus:
            self._refuse(f"triggers on {next(iter(form.plus))}")
        return super().form(form)

    def number(self, value: float | Scheduled) -> Coefficient:
        """Return a number if it is constant; raise an error if it varies from step to step."""
        if isinstance(value, Scheduled):
            self._refuse(f"decides by the {value.by}")
        return super().number(value)

    def coefficients(self, matrix: Matrix) -> list[list[Coefficient]]:
        """Return the entries of a matrix if it is constant; raise an error if it varies from step to step."""
        if isinstance(matrix, Scheduled):
            if (matrix.values != matrix.values[0]).any():
                self._refuse(f"has matrices that vary with the {matrix.by}")
            matrix = matrix.values[0]
        return super().coefficients(matrix)

    def happened(self, condition: Condition) -> list[Truth]:
        """Return the outcome of a condition in this case; raise an error if it depends on packets of earlier steps."""
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
    """Raise an error if a loop cannot be written as a switched linear map. Properties in ``more`` are allowed
    nevertheless.
    """
    policy = loop.policy
    missing = [name for name in uncovered(CERTIFIED, loop.parts) if name not in more]
    functions = [step for step in policy.steps if isinstance(step, Apply)]
    constants = any(ONE in read(step) for step in policy.steps)
    links = [link for link in loop.network.links if loop.network.loss(link) > 0]
    known = {
        f"limits of the intervals between sends ({', '.join(IDEAL_LINK.intervals)}) are given": INTERVALS
        - {"Trigger.excluded"},
        "the plant is not linear": FUNCTION,
        "inputs are clipped (input_limit)": LIMIT & {"plant.input_limit"},
        "the changes of the inputs are limited (input_rate)": LIMIT & {"plant.input_rate"},
        f"{policy.kind} chooses silence only at certain times": INTERVALS & {"Trigger.excluded"},
        f"{policy.kind} {_beyond(functions[0]) if functions else ''}": FUNCTIONS,
        f"{policy.kind} follows a reference": TRACKING,
        f"{policy.kind} adds constants": frozenset({ONE} if constants else ()),
        f"{policy.kind} decides on sets of links by a limit": FIRST,
        "the loop is a finite-horizon run, with a horizon or a discount": ENDING,
        "disturbances or set-points are given": EXOSYSTEM,
        f"the {links[0] if links else ''} link drops packets": LOSSES | BURSTS,
        f"packets contain rounded numbers ({loop.network.payload})": ROUNDING,
        "samples are missing at random (links.NAME.missing)": SAMPLES,
    }
    found = [text for text, names in known.items() if ONE in names or not names.isdisjoint(missing)]
    for text in (*found, *(f"{name} is given" for name in missing)):
        raise ProblemError(f"{text}, {_unserved()}")


def _unserved() -> str:
    return f"which certificates do not support; {SERVED}"


@dataclass(frozen=True, eq=False, repr=False)
class Outcomes(Displayed):
    """Jump linear map of a loop that sends at every step: one linear map for each set of dropped packets and missing
    samples.
    """

    F: Array  # dynamics matrix of each outcome, (outcomes, r, r)
    G: Array  # input matrix of the noise, (r, q)
    M: Array  # matrix of the stage cost z'M_o z of each outcome, (outcomes, r, r)
    constant: float  # cost of every step in addition
    turns: Array  # transition probabilities T between the states of links and sensors, (states, states)
    shares: Array  # share of the steps in each state, (states,)
    odds: Array  # probability of each outcome in each state, (states, outcomes)
    decides: bool  # whether the policy of the loop may skip a send
    reason: str  # reason why outcomes differ, for messages: "losses" or "missing samples"

    def growth(self, power: int) -> float:
        """Compute the asymptotic growth factor per step of the moments of order 2 or 4; 0 if too many to compute."""
        r, states = self.F.shape[1], len(self.turns)
        if r == 0 or (power == 4 and states * r**4 * len(self.F) > MOST_MOMENTS):
            return 0.0
        if states * r**power <= WHOLE:
            # the moments of F z are F⊗F, or F⊗F⊗F⊗F, times those of z
            powers = [reduce(np.kron, [F] * power) for F in self.F]
            each = [sum(p * F for p, F in zip(row, powers, strict=True)) for row in self.odds]
            blocks = [[self.turns[s, after] * each[s] for s in range(states)] for after in range(states)]
            return radius(np.block(blocks))
        start = np.stack([normal_moments(r, power)] * states)
        return growth(lambda moments: self._moved(moments, power), start)

    def cost(self) -> float:
        """Compute the mean cost per step of the loop that sends every packet, from the stationary second moments of its
        state.
        """
        if self.F.shape[1] == 0:
            return self.constant
        if (growth := self.growth(2)) >= 1 - NEARLY:
            raise UnstableError(
                f"with these {self.reason}, the mean square of the state of the loop that sends every packet grows by "
                f"a factor of {growth:.6g} per step; expected smaller probabilities"
            )
        added = np.tensordot(self.turns.T @ self.shares, self.G @ self.G.T, 0)
        moved = _scipy.fixed_point(lambda entries: self._moved(entries.reshape(added.shape), 2).ravel(), added.ravel())
        moments = moved.reshape(added.shape)
        missed = moments - self._moved(moments, 2) - added
        if not float(np.linalg.norm(missed)) <= SOLVED * float(np.linalg.norm(added)):
            raise UnstableError(
                "the second moments of the loop that sends every packet cannot be computed reliably; expected "
                "smaller probabilities, or a larger stability margin"
            )
        stage = np.tensordot(self.odds, self.M, 1)
        return self.constant + float(np.sum(stage * moments))

    def _moved(self, moments: Array, power: int) -> Array:
        """Return the moments after a step without noise, from those before it."""
        check_time()
        each = [pushed(F, moments, power) for F in self.F]
        before = [sum(p * X[s] for p, X in zip(row, each, strict=True)) for s, row in enumerate(self.odds)]
        return np.tensordot(self.turns.T, np.stack(before), 1)


def outcomes(loop: Loop) -> Outcomes | None:
    """Compute the jump linear map of a loop that sends every packet over lossy links, or whose samples may be missing;
    return None for other loops.
    """
    loop = loop.deviations
    sent = {step.link for step in loop.policy.steps if isinstance(step, Send)}
    links = [link for link in loop.network.links if link in sent and loop.network.loss(link) > 0]
    if not links and not loop.network.missing:
        return None
    try:
        refuse_loops(loop, LOSSES | BURSTS | ROUNDING | FIRST | EXOSYSTEM | SAMPLES)
        return _read(loop, links)
    except ProblemError:
        return None


def _read(loop: Loop, links: Sequence[str]) -> Outcomes | None:
    nodes = [*loop.network.missing]
    # rounding does not change the growth
    exact = replace(loop, network=replace(loop.network.delivery, missing=loop.network.missing))
    always = attempt_of(loop.policy)
    if always is None or len(links) + len(nodes) > MOST_LAWS:
        return None
    chances = together([*map(loop.network.chain, links), *map(loop.network.chain_of_samples, nodes)])
    cases = [
        always._replace(lost=[*compress(links, case)], missing=[*compress(nodes, case[len(links) :])])
        for case in chances.cases
    ]
    raw, starts = read_steps(exact, cases)
    seen = _affecting(raw.M, raw.F)
    T = np.eye(raw.states)[:, seen]
    nothing = tuple(np.zeros_like(F) for F in raw.F)
    found = relevant(replace(raw, Psi=nothing, X=raw.X[:0]).changed(T.T, T), starts[seen, :0])
    decides = any(len(trigger.labels) > 1 for trigger in loop.policy.decisions.values())
    reason = " and ".join([*(["losses"] if links else []), *(["missing samples"] if nodes else [])])
    return Outcomes(
        np.stack(found.F), found.G, np.stack(found.M), found.constant, chances.turns, chances.shares, chances.odds,
        decides, reason,
    )  # fmt: skip


def _affecting(costs: Sequence[Array], maps: Sequence[Array]) -> list[int]:
    """Return the states that affect the cost, now or later, by the zeros of the matrices alone."""
    pattern, seen = sum(map(np.abs, maps), np.zeros_like(maps[0])), sum(map(np.abs, costs), np.zeros_like(costs[0]))
    found = set(np.flatnonzero(seen.any(axis=0)).tolist())
    while more := set(np.flatnonzero(pattern[sorted(found)].any(axis=0)).tolist()) - found:
        found |= more
    return sorted(found)


def drifting(loop: Loop, noise: Array) -> tuple[str, ...]:
    """Return the links whose decisions depend on drifting disturbances or set-points even if all packets are sent."""
    policy, needs = loop.policy, loop.problem.followed
    always = attempt_of(policy)
    if needs is None or always is None or not noise[np.ix_(needs.states, needs.states)].any():
        return ()
    try:
        program = loop.whole_program(supplied=True, begin=partial(BoundedStep, policy.kind, always))
        states = len(program.states)
        nothing: dict[Name, Array] = {name: np.zeros(states + 1) for name in program.inputs}
        values = read_polynomials(program, states, nothing)
    except ProblemError:
        return ()
    F = np.array([values[op] for op in program.following])[:, :states]
    d: list[int] = np.flatnonzero(needs.states).tolist()  # the states of the plant come first
    response = _response(F, d)
    if response is None:
        return ()
    forms = {name: as_form(values[op]) for name, op in program.outputs.items() if isinstance(name, Option)}
    found = list[str]()
    for decision, trigger in policy.decisions.items():
        sent = trigger.labels[always.taken[decision]]
        rows = [_rows(forms[Option(decision, label)] - forms[Option(decision, sent)]) for label in trigger.labels]
        compared = np.vstack(rows)[:, :states]
        seen = np.zeros((len(compared), loop.problem.plant.states))
        seen[:, d] = compared @ response
        seen[np.abs(seen) <= CANCELS * (np.abs(compared) @ np.abs(response)).max(axis=1, keepdims=True)] = 0.0
        if needs.wanders(seen, noise):
            found += [step.link for step in policy.steps if isinstance(step, Send) and step.on == decision]
    return tuple(found)


def _response(F: Array, d: list[int]) -> Array | None:
    """Return all states as a response to the states d in the long run, (states, q), or None if there is none."""
    rest, size = [i for i in range(len(F)) if i not in d], balancing(np.abs(F))
    F = F / size[:, None] * size  # so that an entry that is a rounding error can be told from a small one
    q, response = len(d), np.zeros((len(F), len(d)))
    response[d] = np.eye(q)
    if len(rest) * q > MOST_ENTRIES:
        return None
    # the columns of F_zz Π − Π S = −F_zd in turn: (I⊗F_zz − S'⊗I) vec Π = −vec F_zd. Least squares, as a mode that is
    # common to F_zz and S makes the equations singular; then the residual decides whether there is a response.
    S, same = F[np.ix_(d, d)], np.eye(q)
    matrix = np.kron(same, F[np.ix_(rest, rest)]) - np.kron(S.T, np.eye(len(rest)))
    right = -F[np.ix_(rest, d)].T.ravel()
    found: Array = np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0], dtype=np.float64)
    if np.abs(matrix @ found - right).max() > CANCELS * max(1.0, float(np.abs(found).max())):
        return None
    response[rest] = found.reshape(q, len(rest)).T
    response[np.abs(response) <= CANCELS * np.abs(response).max(axis=0)] = 0.0
    return response * size[:, None] / size[d]


def _rows(form: Array) -> Array:
    """Return rows η such that the quadratic part of a form depends on ηz alone."""
    values, vectors = np.linalg.eigh(form)
    large = np.abs(values) > RANK * np.abs(values).max(initial=0.0)
    rows = np.sqrt(np.abs(values[large]))[:, None] * vectors[:, large].T
    return np.where(np.abs(rows) > RANK * np.abs(rows).max(initial=0.0), rows, 0.0)


class BoundedStep(FixedStep):
    """Time step of a loop for a fixed decision, with the quadratic terms of its trigger only. All other terms are
    bounded.
    """

    def take(self, step: Step) -> None:
        """Translate a policy step. Stored quadratic forms and random numbers are replaced by zero."""
        if isinstance(step, Evaluate | Draw):
            self.signals[step.signal] = [self.builder.constant(0.0)]
        else:
            super().take(step)

    def form(self, form: Form) -> int:
        """Translate the quadratic terms of a trigger's form, and omit its other terms."""
        return super().form(Form(form.signals if form.Psi is not None else (), form.Psi, form.constant))
