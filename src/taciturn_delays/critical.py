"""The critical delay of a link: how much longer every packet may take before the loop is unstable.

All delays of the law of a link become longer by the same time. For each, the loop that sends every sample is designed
again: LQG has the gains for the longer delay, and a given controller keeps its own. The critical delay is between two
times, one with a stable loop and one whose mean square grows. If no packet is lost or late at random, this is the delay
margin of the loop.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from taciturn.errors import ProblemError, UnstableError
from taciturn.extend import Displayed, check_time, choice, instance
from taciturn.model.delay import DelayLaw
from taciturn.model.plant import ContinuousPlant
from taciturn.problem import Problem

FIRST = 1 / 8  # of a period, which is added first
WIDTH = 1 / 256  # of a period, between a stable and an unstable delay
MOST = 32  # periods that are added at most


@dataclass(frozen=True, repr=False)
class CriticalDelay(Displayed):
    """How much longer every packet on a link may take.

    Args:
        link: the link.
        stable: the largest time added to all delays for which a stable loop was found, in seconds or steps.
        unstable: the least time for which the loop was unstable; None if it is stable with all that can be computed.
        in_seconds: whether these are seconds; for a discrete plant they are steps.
    """

    link: str
    stable: float
    unstable: float | None
    in_seconds: bool

    def short(self) -> str:
        """Say it in a sentence."""
        least = f"every packet on the {self.link} link may take {self._text(self.stable)} longer"
        if self.unstable is None:
            return f"{least}, the most that can be computed"
        return f"{least}; with {self._text(self.unstable)} more, the loop that sends every sample is unstable"

    __str__ = short

    def _text(self, time: float) -> str:
        return f"{time * 1e3:.4g} ms" if self.in_seconds else f"{time:.0f} step{'s' * (time != 1)}"


def critical_delay(problem: Problem, link: str = "actuator") -> CriticalDelay:
    """Compute how much longer every packet on a link may take before the loop that sends every sample is unstable.

    Args:
        problem: the problem; its links may have constant or random delays, buffers and losses.
        link: the link whose packets take longer.

    Returns:
        The times, in seconds for a continuous plant and in steps for a discrete one.

    Raises:
        UnstableError: the loop is unstable already.
        ProblemError: the network has no such link, or the policy has no design for its delays.

    Source: astrom1997computer

    Example:
        >>> from taciturn import load
        >>> critical_delay(load("two-mass")).unstable is None  # LQG that is designed for each delay is stable
        True
    """
    instance("problem", problem, Problem)
    choice("link", link, tuple(problem.network.links))
    period = problem.design().tick
    continuous = isinstance(problem.plant, ContinuousPlant)
    unit = period if continuous else 1.0

    def settles(added: float) -> bool | None:
        check_time()
        try:
            _with_later(problem, link, added, continuous).design()
        except UnstableError:
            return False
        except ProblemError:  # such as more registers or modes than can be computed
            return None
        return True

    low, high, step = 0.0, None, FIRST * unit if continuous else 1.0
    while high is None and step <= MOST * unit:
        found = settles(step)
        if found is None:
            break
        low, high = (step, None) if found else (low, step)
        step *= 2
    least = WIDTH * unit if continuous else 1.0
    while high is not None and high - low > least * (1 + 1e-9):
        middle = (low + high) / 2 if continuous else float((low + high) // 2)
        low, high = (middle, high) if settles(middle) else (low, middle)
    return CriticalDelay(link, low, high, continuous)


def _with_later(problem: Problem, link: str, added: float, continuous: bool) -> Problem:
    """Return a problem whose packets on a link all take longer."""
    law = problem.network.links[link].delay or DelayLaw((0.0,), ((1.0,),), continuous)
    if continuous and not law.in_seconds:
        period = problem.design().tick
        law = replace(law, waits=tuple(wait * period for wait in law.waits), in_seconds=True)
    return replace(problem, network=problem.network.changed({link: {"delay": law.later(added)}}))
