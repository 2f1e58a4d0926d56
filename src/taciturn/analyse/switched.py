"""Closed loops as switched linear maps z⁺ = F_i z + G w, with the action i that minimises z'Ψ_i z + c_i."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, instance
from taciturn._display import Displayed
from taciturn._modes import factor
from taciturn.analyse.reduction import Coordinates, reduce
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.policy import (
    ENDS,
    ONE,
    Apply,
    Assign,
    Condition,
    Decide,
    Draw,
    Evaluate,
    LinkName,
    Send,
    Step,
    Terms,
)
from taciturn.model.steps import read
from taciturn.model.trigger import Form, Matrix, Scheduled

NOISE_SIGNAL = "noise"  # measurement noise, scaled to unit variance
STATE = "x"
SERVED = "expected linear steps and one trigger that compares quadratic forms, as in lqg, relative or consistent"


@dataclass(frozen=True, eq=False, repr=False)
class Switched(Displayed):
    """Switched linear map of a closed loop with its cost and trigger, in coordinates z of about unit size.

    Args:
        labels: names of the actions.
        F: dynamics matrix of each action, (r, r).
        G: input matrix of the noise w of a step, (r, q): plant noise, then the next measurement's, unit covariance.
        M: cost matrix of each action, (r, r): the stage cost of a step is z'M_i z + ``constant``.
        Psi: trigger matrix of each action, (r, r).
        c: trigger constant of each action.
        X: matrix (n, r) such that X z is the plant's state; in the innovations form, X z is the estimate.
        constant: cost of every step in addition to z'M_i z.
        hidden: mean square of the part of the plant's state that X z excludes.
        sends: the action under which every link that the policy decides on sends, or None.
    """

    labels: tuple[str, ...]
    F: tuple[Array, ...]
    G: Array
    M: tuple[Array, ...]
    Psi: tuple[Array, ...]
    c: tuple[float, ...]
    X: Array
    constant: float
    hidden: float
    sends: int | None

    @property
    def homogeneous(self) -> bool:
        """Whether the send decision depends only on the direction of the state z, so that z can converge to zero."""
        return len(set(self.c)) == 1

    @property
    def states(self) -> int:
        """Number of entries of z."""
        return len(self.G)

    def margins(self, action: int) -> list[tuple[Array, float]]:
        """Return the conditions z'Dz + d ≥ 0 under which an action is taken: (D, d) for every other action."""
        own, others = action, [j for j in range(len(self.labels)) if j != action]
        return [(self.Psi[j] - self.Psi[own], self.c[j] - self.c[own]) for j in others]

    def under(self, action: int) -> Switched:
        """Return the map of the loop that takes the given action at every step."""
        return Switched(
            (self.labels[action],),
            (self.F[action],),
            self.G,
            (self.M[action],),
            (np.zeros_like(self.Psi[action]),),
            (0.0,),
            self.X,
            self.constant,
            self.hidden,
            0,
        )


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
    problem, plant = loop.problem, loop.problem.plant
    spread = factor(plant.V) if plant.V.any() else np.zeros((plant.outputs, 0))
    reading = Reading(loop, {STATE: plant.states}, spread.shape[1])
    reading.given["y"] = plant.C @ reading.memory(STATE) + spread @ reading.noise
    taken = reading.actions()
    moved = [plant.A @ reading.memory(STATE) + plant.B @ signals["input"] for signals in taken]
    disturbance = factor(plant.W) if plant.W.any() else np.zeros((plant.states, 0))
    stage = np.block([[problem.Q, problem.N], [problem.N.T, problem.R]])
    paid = [np.vstack([reading.memory(STATE), signals["input"]]) for signals in taken]
    G = np.zeros((reading.size, disturbance.shape[1] + spread.shape[1]))
    G[reading.rows(STATE), : disturbance.shape[1]] = disturbance
    G[reading.rows(NOISE_SIGNAL), disturbance.shape[1] :] = np.eye(spread.shape[1])
    raw = Coordinates(
        F=tuple(reading.following({**signals, STATE: after}) for signals, after in zip(taken, moved, strict=True)),
        G=G,
        M=tuple(both.T @ stage @ both for both in paid),
        Psi=reading.Psi,
        X=reading.memory(STATE)[problem.moving],
        starts=np.column_stack([reading.memory(STATE).T, reading.start()]),
    )
    return _finished(reading, reduce(raw, reading.c), 0.0, 0.0)


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
    innovations, problem = loop.policy.theory.innovations, loop.problem
    if not loop.reducible or innovations is None:
        raise ProblemError(
            "the loop has no innovations form: its plant, network or horizon is not that of the design; "
            "expected those of the design; for any other loop, use switched()"
        )
    spread = factor(innovations.covariance)
    reading = Reading(loop, {}, spread.shape[1])
    reading.given[innovations.signal] = spread @ reading.noise
    taken = reading.actions()
    stage = np.block([[problem.Q, problem.N], [problem.N.T, problem.R]])
    estimate = innovations.estimate
    paid = [np.vstack([signals[estimate], signals["input"]]) for signals in taken]
    raw = Coordinates(
        F=tuple(reading.following(signals) for signals in taken),
        G=np.eye(reading.size)[:, reading.rows(NOISE_SIGNAL)],
        M=tuple(both.T @ stage @ both for both in paid),
        Psi=reading.Psi,
        X=taken[0][estimate][problem.moving],
        starts=reading.start()[:, None],
    )
    Sigma = innovations.error_covariance
    constant = float(np.trace(problem.Q @ Sigma))
    return _finished(reading, reduce(raw, reading.c), constant, float(np.diag(Sigma)[problem.moving].sum()))


def _finished(reading: Reading, found: Coordinates, constant: float, hidden: float) -> Switched:
    return Switched(
        labels=reading.labels,
        F=found.F,
        G=found.G,
        M=found.M,
        Psi=found.Psi,
        c=reading.c,
        X=found.X,
        constant=constant,
        hidden=hidden,
        sends=reading.sends(),
    )


class Reading:
    """Signals of a policy in one step as linear maps of the loop's memories and the measurement noise.

    Args:
        loop: the closed loop.
        more: memories of the loop in addition to the policy's, with their sizes.
        noise: number of directions of the measurement noise.
    """

    def __init__(self, loop: Loop, more: Mapping[str, int], noise: int) -> None:
        """Find the memories and their sizes."""
        policy = loop.policy
        self.policy = policy
        innovation = policy.theory.innovations.signal if policy.theory.innovations is not None and not more else None
        self.steps = [s for s in policy.steps if not (isinstance(s, Assign) and s.signal == innovation)]
        assigned = {"y", *more, *(() if innovation is None else (innovation,))}
        sizes = dict(more)
        for step in self.steps:
            for name in _read(step):
                if name not in assigned:
                    sizes.setdefault(name, policy.sizes[name])
            if isinstance(step, Assign):
                assigned.add(step.signal)
        self.sizes = {**sizes, NOISE_SIGNAL: noise}
        self.size = sum(self.sizes.values())
        self.given: dict[str, Array] = {}
        self.noise = self.memory(NOISE_SIGNAL)
        decisions = list(policy.decisions.items())
        if len(decisions) > 1:
            raise ProblemError(f"{policy.kind} makes {len(decisions)} decisions per step, {_unserved()}")
        self.labels = decisions[0][1].labels if decisions else ("always",)
        self.Psi: tuple[Array, ...] = (np.zeros((self.size, self.size)),)
        self.c: tuple[float, ...] = (0.0,)

    def rows(self, name: str) -> slice:
        """Return the positions of a memory's entries in the vector z."""
        names = list(self.sizes)
        first = sum(self.sizes[other] for other in names[: names.index(name)])
        return slice(first, first + self.sizes[name])

    def memory(self, name: str) -> Array:
        """Return the matrix that maps the vector z to one memory (stored signal) of the policy."""
        return np.eye(self.size)[self.rows(name)]

    def start(self) -> Array:
        """Return the vector z with the initial values of the policy's memories."""
        value = np.zeros(self.size)
        for name in self.sizes:
            if name in self.policy.initial and name != STATE:
                value[self.rows(name)] = self.policy.initial[name]
        return value

    def following(self, signals: Mapping[str, Array]) -> Array:
        """Return the matrix that maps z to the memories of the next step, with zero rows for new measurement noise."""
        rows = [signals[name] for name in self.sizes if name != NOISE_SIGNAL]
        return np.vstack([*rows, np.zeros((self.sizes[NOISE_SIGNAL], self.size))])

    def sends(self) -> int | None:
        """Return the action with a send on every link that has a send decision, or None if there is no such action."""
        for action in range(len(self.labels)):
            sent = {s.link for s in self.steps if isinstance(s, Send) and self._is_sent(s, action)}
            if sent.issuperset(self.policy.scheduled):
                return action
        return None

    def actions(self) -> list[dict[str, Array]]:
        """Return the signals of the policy at the end of a step, for each action."""
        return [self.walk(action) for action in range(len(self.labels))]

    def walk(self, action: int, lost: Collection[LinkName] = ()) -> dict[str, Array]:
        """Return the policy's signals at the end of a step for an action, if the links ``lost`` drop their packets."""
        signals = {name: self.memory(name) for name in self.sizes} | self.given
        arrived: dict[str, int] = {}
        for step in self.steps:
            if isinstance(step, Assign):
                outcome = self._outcome(step.on, action, arrived)
                signals[step.signal] = self._combined(step.branches[outcome], signals)
            elif isinstance(step, Decide):
                forms = [self._form(form, signals) for form in step.trigger.options.values()]
                self.Psi, self.c = tuple(Psi for Psi, _ in forms), tuple(c for _, c in forms)
            elif isinstance(step, Send):
                arrived[step.link] = int(self._is_sent(step, action) and step.link not in lost)
            else:
                raise ProblemError(f"{self.policy.kind} {_beyond(step)}, {_unserved()}")
        return signals

    def _outcome(self, on: Condition | None, action: int, arrived: Mapping[str, int]) -> int:
        if on is None:
            return 0
        if isinstance(on, str):
            return action
        if on.link not in arrived:
            raise ProblemError(f"{self.policy.kind} uses a packet of the previous step, {_unserved()}")
        return arrived[on.link]

    def _is_sent(self, step: Send, action: int) -> bool:
        return step.on is None or self.labels[action] in (step.labels or self.labels[1:])

    def _combined(self, terms: Terms, signals: Mapping[str, Array]) -> Array:
        parts = [self._constant(weight) @ signals[name] for name, weight in terms.items()]
        return np.sum(parts, axis=0)

    def _form(self, form: Form, signals: Mapping[str, Array]) -> tuple[Array, float]:
        if form.bell is not None:
            raise ProblemError(f"{self.policy.kind} triggers on the exponential of a quadratic form, {_unserved()}")
        if form.plus:
            raise ProblemError(f"{self.policy.kind} triggers on {next(iter(form.plus))}, {_unserved()}")
        if isinstance(form.constant, Scheduled):
            raise ProblemError(f"{self.policy.kind} decides by the {form.constant.by}, {_unserved()}")
        if form.Psi is None:
            return np.zeros((self.size, self.size)), form.constant
        stacked = np.vstack([signals[name] for name in form.signals])
        return stacked.T @ self._constant(form.Psi) @ stacked, form.constant

    def _constant(self, weight: Matrix) -> Array:
        """Return a matrix; a schedule of equal matrices becomes one matrix."""
        if not isinstance(weight, Scheduled):
            return weight
        if (weight.values != weight.values[0]).any():
            raise ProblemError(f"{self.policy.kind} has matrices that vary with the {weight.by}, {_unserved()}")
        return weight.values[0]


def _read(step: Step) -> Iterator[str]:
    """Yield the signals that the result of a step depends on, in order."""
    if not isinstance(step, Send):
        yield from read(step)


def _beyond(step: Evaluate | Apply | Draw) -> str:
    """Return the reason why a step is not linear."""
    if isinstance(step, Draw):
        return "has a random threshold"
    if isinstance(step, Apply):
        return f"computes {', '.join(step.signals)} by a function"
    return f"stores {step.signal}, a quadratic form"


def refuse_loops(loop: Loop, dropping: bool = False) -> None:
    """Raise an error if a loop is not a switched linear map over an infinite horizon.

    ``dropping`` allows links that drop packets.
    """
    policy, network = loop.policy, loop.network
    sent = {step.link for step in policy.steps if isinstance(step, Send)}
    lost = [link for link in ENDS if link in sent and network.loss(link) > 0]
    functions = [step for step in policy.steps if isinstance(step, Apply)]
    found = {
        "the plant is not linear": loop.problem.plant.function is not None,
        f"{policy.kind} {_beyond(functions[0]) if functions else ''}": bool(functions),
        f"{policy.kind} follows a reference": policy.tracking is not None,
        f"{policy.kind} adds constants": any(ONE in _read(step) for step in policy.steps),
        "the loop is a finite-horizon run, with a horizon or a discount": loop.horizon is not None,
        "inputs are clipped (input_limit)": loop.problem.plant.input_limit is not None,
        f"the {lost[0] if lost else ''} link drops packets": bool(lost) and not dropping,
    }
    for text, given in found.items():
        if given:
            raise ProblemError(f"{text}, {_unserved()}")


def _unserved() -> str:
    return f"which certificates do not support; {SERVED}"
