"""Options of links and of processes: packet dropouts, bursts and outages; numbers of steps; the length of a step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from taciturn.model.losses import LossLaw
    from taciturn.model.network import Network
    from taciturn.model.policy import Policy
    from taciturn.runtime.relay import Fate


def read_probability(name: str, text: str) -> float:
    """Read the value of a command-line option as a probability."""
    from taciturn._arrays import number
    from taciturn.errors import ProblemError

    try:
        found = float(text)
    except ValueError:
        raise ProblemError(f"{name} is {text!r}; expected a number from 0 to 1, such as 0.2") from None
    return number(name, found, 0.0, 1.0, closed=True)


def read_fates(given: Sequence[str], policy: Policy, network: Network, seed: int) -> dict[str, Fate]:
    """Return the impairments of each link: the losses of --loss, or else those of the problem's network."""
    from taciturn.errors import ProblemError
    from taciturn.model.policy import Send
    from taciturn.study.testbed.network import losses

    stated = losses(network, seed)
    fates: dict[str, Fate] = {step.link: stated[step.link] for step in policy.steps if isinstance(step, Send)}
    seen: set[str] = set()
    for text in given:
        link, named, chance = text.rpartition("=")
        if link in seen:
            raise ProblemError(f"--loss is given twice for {link or 'all links'}; expected one value for each link")
        seen.add(link)
        if named and link not in fates:
            raise ProblemError(f"--loss names the link {link!r}; expected a link of {policy.kind}: {', '.join(fates)}")
        for one, fate in fates.items():
            if not named or one == link:
                fates[one] = replace(fate, loss=read_probability("--loss", chance), burst=None)
    return fates


def read_burst(text: str | None) -> LossLaw | None:
    """Return the law of bursty losses of a link from the values of --burst, or None."""
    from taciturn.model.bursts import read_law

    return None if text is None else read_law("--burst", text)


def read_outage(text: str | None) -> tuple[int, int] | None:
    """Return the first step of an outage and the step at which it ends, or None."""
    from taciturn.errors import ProblemError

    if text is None:
        return None
    try:
        first, end = map(int, text.split(","))
    except ValueError:
        raise ProblemError(f"--outage is {text!r}; expected two steps, such as 20,40") from None
    return first, end


def check_counts(counts: Mapping[str, int | None]) -> None:
    """Raise an error if an option is below 1, or if there are more loops than a packet's loop number can represent."""
    from taciturn._arrays import count, number

    for name, value in counts.items():
        if value is not None:
            count(name, value)
    number("--loops", counts.get("--loops") or 1, high=65535, closed=True)


def tick_length(of_problem: float | None, real_time: bool, asked: float | None) -> float | None:
    """Return the seconds per step in real time, or None in virtual time."""
    from taciturn._arrays import number
    from taciturn.errors import ProblemError

    if asked is not None and not real_time:
        raise ProblemError("--tick is given without --real-time; expected both options, or neither of them")
    if not real_time:
        return None
    return of_problem or 1.0 if asked is None else number("--tick", asked, 1e-4, 3600.0, closed=True)
