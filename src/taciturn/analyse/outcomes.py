"""Jump linear maps z⁺ = F_o z + G w of loops over lossy links; the outcome o lists the links that drop a packet.

The probability of an outcome depends only on the state of the links. Therefore the second and the fourth moments of z
satisfy linear recursions. The moments exist in the long run only if these recursions are stable:

    X_s⁺ = Σ_r T_rs Σ_o p(o | r) (F_o X_r F_o' + π_r G G'),

where X_s is the second moment while the links are in state s, T contains the transition probabilities of the links, and
π_r is the share of the steps in state r. For the fourth moment F_o acts on all four indices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import product

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array, pushed
from taciturn._display import Displayed
from taciturn._growth import growth, normal_moments
from taciturn._modes import radius
from taciturn._progress import check_time
from taciturn.analyse.reduction import relevant
from taciturn.analyse.switched import attempt_of, read_steps, refuse_loops
from taciturn.errors import ProblemError, UnstableError
from taciturn.loop import Loop
from taciturn.model.coverage import BURSTS, EXOSYSTEM, FIRST, LOSSES, ROUNDING
from taciturn.model.losses import stationary
from taciturn.model.network import Network
from taciturn.model.policy import Send

MOST = 100_000  # largest number of fourth moments, times the outcomes, for which their growth is computed
SOLVED = 1e-9  # relative residual of the equation for the second moments
NEARLY = 1e-9  # distance to a growth of 1 within which the second moments count as divergent
MOST_LINKS = 6  # largest number of links that drop packets, which have 2^links outcomes
WHOLE = 400  # largest number of rows of a recursion matrix that is stored as a dense matrix


@dataclass(frozen=True, eq=False, repr=False)
class Outcomes(Displayed):
    """Jump linear map of a loop that sends at every step, over links that drop some packets.

    Args:
        F: dynamics matrix of each outcome, (outcomes, r, r).
        G: input matrix of the noise, (r, q).
        M: matrix of the stage cost z'M_o z of each outcome, (outcomes, r, r).
        constant: cost of every step in addition.
        turns: transition probabilities T between the states of the links, (states, states).
        shares: share of the steps in each state of the links, (states,).
        odds: probability of each outcome in each state of the links, (states, outcomes).
        decides: whether the policy of the loop may skip a send.
    """

    F: Array
    G: Array
    M: Array
    constant: float
    turns: Array
    shares: Array
    odds: Array
    decides: bool

    def growth(self, power: int) -> float:
        """Return the asymptotic growth factor per step of the second or fourth moments of the loop's state.

        For order 4 the result is 0 if there are too many states.
        """
        r, states = self.F.shape[1], len(self.turns)
        if r == 0 or (power == 4 and states * r**4 * len(self.F) > MOST):
            return 0.0
        if states * r**power <= WHOLE:
            powers = [reduce(np.kron, [F] * power) for F in self.F]
            each = [sum(p * F for p, F in zip(row, powers, strict=True)) for row in self.odds]
            blocks = [[self.turns[s, after] * each[s] for s in range(states)] for after in range(states)]
            return radius(np.block(blocks))
        start = np.stack([normal_moments(r, power)] * states)
        return growth(lambda moments: self._moved(moments, power), start)

    def cost(self) -> float:
        """Return the cost per step of the loop that sends every packet, by its second moments in the long run.

        Raises:
            UnstableError: the second moments diverge, or cannot be computed reliably.
        """
        if self.F.shape[1] == 0:
            return self.constant
        if (growth := self.growth(2)) >= 1 - NEARLY:
            raise UnstableError(
                f"with these losses, the mean square of the loop that sends every packet grows by a factor of "
                f"{growth:.6g} per step; expected fewer losses"
            )
        added = np.tensordot(self.turns.T @ self.shares, self.G @ self.G.T, 0)
        moved = _scipy.fixed_point(lambda entries: self._moved(entries.reshape(added.shape), 2).ravel(), added.ravel())
        moments = moved.reshape(added.shape)
        missed = moments - self._moved(moments, 2) - added
        if not float(np.linalg.norm(missed)) <= SOLVED * float(np.linalg.norm(added)):
            raise UnstableError(
                "the second moments of the loop that sends every packet cannot be computed reliably; expected fewer "
                "losses, or a larger stability margin"
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
    """Return the jump linear map of a loop that sends every packet over lossy links.

    The result is None if no link drops packets, or if the loop is not a jump linear map.
    """
    loop = loop.deviations
    sent = {step.link for step in loop.policy.steps if isinstance(step, Send)}
    links = [link for link in loop.network.links if link in sent and loop.network.loss(link) > 0]
    if not links:
        return None
    try:
        refuse_loops(loop, LOSSES | BURSTS | ROUNDING | FIRST | EXOSYSTEM)
        return _read(loop, links)
    except ProblemError:
        return None


def _read(loop: Loop, links: Sequence[str]) -> Outcomes | None:
    exact = replace(loop, network=loop.network.delivery)  # rounding does not change the growth
    always = attempt_of(loop.policy)
    if always is None or len(links) > MOST_LINKS:
        return None
    cases = list(product((False, True), repeat=len(links)))
    lost = [[link for link, gone in zip(links, dropped, strict=True) if gone] for dropped in cases]
    raw, starts = read_steps(exact, [always._replace(lost=links) for links in lost])
    seen = _affecting(raw.M, raw.F)
    T = np.eye(raw.states)[:, seen]
    nothing = tuple(np.zeros_like(F) for F in raw.F)
    found = relevant(replace(raw, Psi=nothing, X=raw.X[:0]).changed(T.T, T), starts[seen, :0])
    turns, shares, odds = _chance(loop.network, links, cases)
    decides = any(len(trigger.labels) > 1 for trigger in loop.policy.decisions.values())
    return Outcomes(np.stack(found.F), found.G, np.stack(found.M), found.constant, turns, shares, odds, decides)


def _affecting(costs: Sequence[Array], maps: Sequence[Array]) -> list[int]:
    """Return the states that affect the cost, now or later, by the zeros of the matrices alone."""
    pattern, seen = sum(map(np.abs, maps), np.zeros_like(maps[0])), sum(map(np.abs, costs), np.zeros_like(costs[0]))
    found = set(np.flatnonzero(seen.any(axis=0)).tolist())
    while more := set(np.flatnonzero(pattern[sorted(found)].any(axis=0)).tolist()) - found:
        found |= more
    return sorted(found)


def _chance(network: Network, links: Sequence[str], cases: list[tuple[bool, ...]]) -> tuple[Array, Array, Array]:
    """Return the joint transition matrix of the links, their shares, and the probability of each case in each state."""
    turns: Array = np.ones((1, 1))
    shares: Array = np.ones(1)
    losses: list[tuple[float, ...]] = [()]
    for link in links:
        own, drops = network.chain(link)
        turns = np.asarray(np.kron(turns, own), dtype=np.float64)
        shares = np.asarray(np.kron(shares, stationary(own)), dtype=np.float64)
        losses = [(*before, drop) for before in losses for drop in drops.tolist()]
    odds = [
        [float(np.prod([p if gone else 1 - p for p, gone in zip(state, case, strict=True)])) for case in cases]
        for state in losses
    ]
    return turns, shares, np.array(odds)
