"""Closed loops as matrices: z⁺ = F_i z + G w under the action i, taken where z'Ψ_i z + c_i is least."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, instance
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

NOISE = "noise"  # of the measurement, in directions of unit variance
STATE = "x"
SERVED = "expected linear steps and one trigger of quadratic forms, as of lqg, relative or consistent"


@dataclass(frozen=True, eq=False)
class Switched:
    """The switched linear map of a loop, in coordinates z of about unit size.

    Args:
        labels: of the actions.
        F: of each action, (r, r).
        G: (r, q), by which the noise w of a tick acts: of the plant, then of the next measurement, of unit covariance.
        M: of each action, (r, r): the stage cost of a tick is z'M_i z + ``constant``.
        Psi: of each action, (r, r).
        c: of each action.
        X: (n, r): the plant's state is X z; of a loop seen by its filter, the estimate.
        constant: what every tick costs beside.
        hidden: mean square of the part of the plant's state that X z leaves out.
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
        """Whether the actions look at the direction of z alone, so that the state can vanish."""
        return len(set(self.c)) == 1

    @property
    def states(self) -> int:
        """Number of entries of z."""
        return len(self.G)

    def margins(self, action: int) -> list[tuple[Array, float]]:
        """Return (D, d) with z'Dz + d ≥ 0 wherever the action is taken, one for every other action."""
        own, others = action, [j for j in range(len(self.labels)) if j != action]
        return [(self.Psi[j] - self.Psi[own], self.c[j] - self.c[own]) for j in others]

    def under(self, action: int) -> Switched:
        """Return the loop that takes one action always."""
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
    """Return the matrices of a closed loop with its plant.

    z holds what decides on the future: the plant's state, the memories of the nodes, and the measurement noise of the
    tick. What no noise and no initial state of the plant reaches, and what neither costs nor acts, is left out (the
    controller's copy of what the actuator holds).

    Args:
        loop: the closed loop, nominal or not.

    Returns:
        The map, the stage cost and the trigger.

    Raises:
        ProblemError: the loop has a step, a location or a plant that is not of this form.

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
    G[reading.rows(NOISE), disturbance.shape[1] :] = np.eye(spread.shape[1])
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
    """Return the matrices of a closed loop as its filter sees it: driven by innovations, without the plant.

    Equal in law to :func:`switched` where the loop is nominal and its filter steady; ``constant`` is tr(QΣ).

    Args:
        loop: the closed loop.

    Raises:
        ProblemError: the loop has no innovations form, or is not of the switched linear form.

    Source: khashooei2017
    """
    instance("loop", loop, Loop)
    refuse_loops(loop)
    innovations, problem = loop.policy.innovations, loop.problem
    if not loop.reducible or innovations is None:
        raise ProblemError(
            "the loop has no innovations form: its plant, network or horizon is not that of the design; "
            "expected the loop of the design, or the one with its plant"
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
        G=np.eye(reading.size)[:, reading.rows(NOISE)],
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
    """The signals of one tick as linear maps of what is remembered and of the measurement noise.

    Args:
        loop: the closed loop.
        more: memories that the loop has beside the policy's, with their sizes.
        noise: directions of the measurement noise.
    """

    def __init__(self, loop: Loop, more: Mapping[str, int], noise: int) -> None:
        """Find what is remembered, and how large it is."""
        policy = loop.policy
        self.policy = policy
        innovation = policy.innovations.signal if policy.innovations is not None and not more else None
        self.steps = [s for s in policy.steps if not (isinstance(s, Assign) and s.signal == innovation)]
        assigned = {"y", *more, *(() if innovation is None else (innovation,))}
        sizes = dict(more)
        for step in self.steps:
            for name in _read(step):
                if name not in assigned:
                    sizes.setdefault(name, policy.sizes[name])
            if isinstance(step, Assign):
                assigned.add(step.signal)
        self.sizes = {**sizes, NOISE: noise}
        self.size = sum(self.sizes.values())
        self.given: dict[str, Array] = {}
        self.noise = self.memory(NOISE)
        decisions = list(policy.decisions.items())
        if len(decisions) > 1:
            raise ProblemError(f"{policy.kind} takes {len(decisions)} decisions, {_unserved()}")
        self.labels = decisions[0][1].labels if decisions else ("always",)
        self.Psi: tuple[Array, ...] = (np.zeros((self.size, self.size)),)
        self.c: tuple[float, ...] = (0.0,)

    def rows(self, name: str) -> slice:
        """Return where a memory stands."""
        names = list(self.sizes)
        first = sum(self.sizes[other] for other in names[: names.index(name)])
        return slice(first, first + self.sizes[name])

    def memory(self, name: str) -> Array:
        """Return the map to a memory."""
        return np.eye(self.size)[self.rows(name)]

    def start(self) -> Array:
        """Return what the policy remembers at first."""
        value = np.zeros(self.size)
        for name in self.sizes:
            if name in self.policy.initial and name != STATE:
                value[self.rows(name)] = self.policy.initial[name]
        return value

    def following(self, signals: Mapping[str, Array]) -> Array:
        """Return the map to the memories of the next tick, whose measurement noise is drawn anew."""
        rows = [signals[name] for name in self.sizes if name != NOISE]
        return np.vstack([*rows, np.zeros((self.sizes[NOISE], self.size))])

    def sends(self) -> int | None:
        """Return the action under which every link that is decided on sends."""
        for action in range(len(self.labels)):
            sent = {s.link for s in self.steps if isinstance(s, Send) and self._is_sent(s, action)}
            if sent.issuperset(self.policy.scheduled):
                return action
        return None

    def actions(self) -> list[dict[str, Array]]:
        """Return the signals at the end of a tick for each action."""
        return [self.walk(action) for action in range(len(self.labels))]

    def walk(self, action: int, lost: Collection[LinkName] = ()) -> dict[str, Array]:
        """Return the signals at the end of a tick for an action, where the packets of some links are lost."""
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
            raise ProblemError(f"{self.policy.kind} uses a packet of the tick before, {_unserved()}")
        return arrived[on.link]

    def _is_sent(self, step: Send, action: int) -> bool:
        return step.on is None or self.labels[action] in (step.labels or self.labels[1:])

    def _combined(self, terms: Terms, signals: Mapping[str, Array]) -> Array:
        parts = [self._constant(weight) @ signals[name] for name, weight in terms.items()]
        return np.sum(parts, axis=0)

    def _form(self, form: Form, signals: Mapping[str, Array]) -> tuple[Array, float]:
        if form.bell is not None:
            raise ProblemError(f"{self.policy.kind} triggers on the exponential of a quadratic, {_unserved()}")
        if form.plus:
            raise ProblemError(f"{self.policy.kind} triggers on {next(iter(form.plus))}, {_unserved()}")
        if isinstance(form.constant, Scheduled):
            raise ProblemError(f"{self.policy.kind} decides by the {form.constant.by}, {_unserved()}")
        if form.Psi is None:
            return np.zeros((self.size, self.size)), form.constant
        stacked = np.vstack([signals[name] for name in form.signals])
        return stacked.T @ self._constant(form.Psi) @ stacked, form.constant

    def _constant(self, weight: Matrix) -> Array:
        """Return a matrix, or the table of equal ones as one."""
        if not isinstance(weight, Scheduled):
            return weight
        if (weight.values != weight.values[0]).any():
            raise ProblemError(f"{self.policy.kind} has matrices that vary with the {weight.by}, {_unserved()}")
        return weight.values[0]


def _read(step: Step) -> Iterator[str]:
    """Yield the signals that what a step computes depends on, in order."""
    if not isinstance(step, Send):
        yield from read(step)


def _beyond(step: Evaluate | Apply | Draw) -> str:
    """Return what is not linear in a step."""
    if isinstance(step, Draw):
        return "draws a threshold"
    if isinstance(step, Apply):
        return f"computes {', '.join(step.signals)} by a function"
    return f"remembers {step.signal}, a quadratic form"


def refuse_loops(loop: Loop, dropping: bool = False) -> None:
    """Refuse what makes a loop other than a switched linear map without end; packets that are lost, unless expected."""
    policy, network = loop.policy, loop.network
    sent = {step.link for step in policy.steps if isinstance(step, Send)}
    lost = [link for link in ENDS if link in sent and network.loss(link) > 0]
    functions = [step for step in policy.steps if isinstance(step, Apply)]
    found = {
        "the plant is not linear": loop.problem.plant.function is not None,
        f"{policy.kind} {_beyond(functions[0]) if functions else ''}": bool(functions),
        f"{policy.kind} follows a reference": policy.tracking is not None,
        f"{policy.kind} adds constants": any(ONE in _read(step) for step in policy.steps),
        "the loop is a mission, with a horizon or a discount": loop.horizon is not None,
        "inputs are clipped (input_limit)": loop.problem.plant.input_limit is not None,
        f"packets of the {lost[0] if lost else ''} link are lost": bool(lost) and not dropping,
    }
    for text, given in found.items():
        if given:
            raise ProblemError(f"{text}, {_unserved()}")


def _unserved() -> str:
    return f"and no certificate serves that; {SERVED}"
