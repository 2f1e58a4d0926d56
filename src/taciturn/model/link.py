"""Model of a link: losses, delays, acknowledgements, quantisation, price and energy per packet, and traffic limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, cast

import numpy as np

from taciturn._arrays import choice, count, flag, instance, number
from taciturn._display import Displayed
from taciturn._text import number_of, percent
from taciturn.errors import ProblemError
from taciturn.model.delay import DelayLaw, Wait, check_delay, wait_from
from taciturn.model.estimate import Estimate
from taciturn.model.key import stated_as
from taciturn.model.losses import LossLaw
from taciturn.model.wire import CODES, EncodingName

ProtocolName = Literal["udp", "tcp", "ideal"]
ACKNOWLEDGED: Mapping[str, bool | None] = {"udp": False, "tcp": True, "ideal": None}  # by protocol
LONGEST = 1_000_000  # steps of an interval between sends
MOST = 1e100  # largest price, energy and battery, and inverse of the least


@dataclass(frozen=True, repr=False)
class LinkLaw(Displayed):
    """The properties of a link between two nodes: losses, acknowledgements, encoding, prices and traffic limits.

    A model of bursty losses that never leaves its initial state is stored as its loss probability.

    Args:
        loss: loss probability of a packet, in [0, 1].
        burst: bursty losses instead of ``loss``: a ``Burst``, or another law derived from ``LossLaw``.
        acknowledged: whether the sender learns whether each packet arrives; None for a link on which every packet
            arrives, and False if losses are given without it.
        payload: encoding of the numbers in a packet: ``"float64"`` (exact), or ``"float32"`` or ``"int16"`` (rounded).
        range: with ``"int16"``, full-scale value of the numbers in a packet: one number, or one per entry.
        price: price of a packet relative to the packets of other links.
        energy: joules that the sender spends on a packet, or None.
        battery: joules in the battery of the sender, or None.
        min_interval: least number of steps from one send to the next.
        max_interval: largest number of steps from one send to the next, or None.
        delay: law of the delay of packets: a whole number of steps, a list of probabilities of 0, 1, 2, … steps, or a
            table: ``{"seconds": 0.004}``, ``{"seconds": […], "probability": […]}``, ``{"histogram": "file.csv"}``,
            ``{"trace": "file.csv"}``, or with a burst ``{"states": [law, law]}``; default: no delay.
        buffer: steps, or ``{"seconds": x}``, after which the receiver uses each packet; a later one is lost. None: it
            uses a packet when it arrives.
        acknowledgement_delay: steps after which the sender learns what has arrived in a step: 0, before its next
            decision, or 1.

    Raises:
        ProblemError: if a probability is outside [0, 1], loss and burst are both given, a range, price or energy is not
            positive, a battery is given without the energy of a packet, no interval is within the limits, or delay and
            buffer have different units or drop every packet.

    Example:
        >>> LinkLaw(loss=0.1).protocol, LinkLaw().protocol
        ('udp', 'ideal')
    """

    loss: float = 0.0
    burst: LossLaw | None = field(default=None, metadata=stated_as(dict[str, Any] | None))
    acknowledged: bool | None = None
    payload: EncodingName = field(default="float64", metadata=stated_as(str))
    range: tuple[float, ...] | None = field(default=None, metadata=stated_as(float | list[float] | None))
    price: float = 1.0
    energy: float | None = None
    battery: float | None = None
    min_interval: int = 1
    max_interval: int | None = None
    delay: DelayLaw | None = field(default=None, metadata=stated_as(Any))  # checked below, with all its forms
    buffer: Wait | None = field(default=None, metadata=stated_as(Any))
    acknowledgement_delay: int = 0

    def __post_init__(self) -> None:
        """Check the arguments."""
        loss = number("loss", self.loss, 0.0, 1.0, closed=True)
        if self.burst is not None:
            instance("burst", self.burst, LossLaw)
            if loss > 0:
                raise ProblemError("loss and burst are both given; expected one of them")
            self.burst.check()
            if self.burst.constant:
                loss = self.burst.loss
                object.__setattr__(self, "acknowledged", self.acknowledged or False)
                object.__setattr__(self, "burst", None)
        object.__setattr__(self, "loss", loss)  # a float even if the integer 0 was given
        self._check_delay()
        if self.acknowledged is None and (loss > 0 or self.burst is not None or self._drops):
            object.__setattr__(self, "acknowledged", False)
        if count("acknowledgement_delay", self.acknowledgement_delay, 0) > 1 or (
            self.acknowledgement_delay and not self.acknowledged
        ):
            raise ProblemError(
                f"acknowledgement_delay is {self.acknowledgement_delay}, and acknowledged is "
                f"{str(bool(self.acknowledged)).lower()}; expected 0, or 1 on a link with acknowledgements"
            )
        choice("payload", self.payload, CODES)
        if self.range is not None:
            if self.payload != "int16":
                raise ProblemError(
                    f"range is given with payload = {self.payload!r}; expected a range only with payload = 'int16'"
                )
            listed = cast("object", self.range)
            given = cast("Sequence[object]", listed if isinstance(listed, list | tuple) else (listed,))
            object.__setattr__(self, "range", tuple(number("range", entry, 0.0) for entry in given))
        for name in ("price", "energy", "battery"):
            if getattr(self, name) is not None:  # their ratios and sums are finite
                object.__setattr__(self, name, number(name, getattr(self, name), 1 / MOST, MOST, closed=True))
        if self.acknowledged is not None:
            object.__setattr__(self, "acknowledged", flag("acknowledged", self.acknowledged))
        if self.battery is not None and self.energy is None:
            raise ProblemError("battery is given without energy; expected energy, the joules per packet")
        for name in ("min_interval", "max_interval"):
            steps = getattr(self, name)
            if steps is not None and count(name, steps) > LONGEST:
                raise ProblemError(f"{name} is {steps}; expected at most {LONGEST} steps")
        if self.max_interval is not None and self.max_interval < self.min_interval:
            raise ProblemError(
                f"max_interval is {self.max_interval}, and min_interval is {self.min_interval}; expected max_interval "
                "≥ min_interval"
            )

    def _check_delay(self) -> None:
        """Check law of delay and buffer, and convert them from the forms of a problem file."""
        law = self.delay if isinstance(cast("object", self.delay), DelayLaw) else check_delay(self.delay)
        if law is not None and len(law.odds) > 1 and (self.burst is None or len(self.burst.losses) != len(law.odds)):
            states = "no burst" if self.burst is None else f"a burst with {number_of(len(self.burst.losses), 'state')}"
            raise ProblemError(
                f"delay.states has {number_of(len(law.odds), 'law')}, and the link has {states}; expected a burst with "
                "as many states"
            )
        buffer = None if self.buffer is None else wait_from("buffer", self.buffer)
        if buffer is not None and law is not None:
            if not any(buffer):
                raise ProblemError("buffer is 0, and packets are delayed; expected a buffer above 0, or no buffer")
            if law.in_seconds != (buffer.steps == 0 and buffer.seconds > 0):
                raise ProblemError(
                    f"buffer is {buffer.text()}, and delay is {law.text()}; expected both in steps or both in seconds"
                )
            if all(late >= 1.0 for late in law.later_than(buffer)):
                raise ProblemError(
                    f"buffer is {buffer.text()}, and the least delay is {law.wait(0).text()}, so every packet is late; "
                    "expected a larger buffer"
                )
        object.__setattr__(self, "delay", law)
        object.__setattr__(self, "buffer", buffer if buffer is not None and any(buffer) else None)

    @property
    def _drops(self) -> bool:
        """Whether delays let a sender doubt that, or when, a packet has arrived."""
        if self.delay is None or self.delay.constant is not None:
            return False
        return self.buffer is None or any(self.delay.later_than(self.buffer))

    @property
    def wait(self) -> Wait:
        """The delay after which the receiver uses each packet that it uses, if it is always the same; otherwise 0."""
        if self.played().delay is not None:
            return Wait()
        return self._used_after or Wait()

    @property
    def _used_after(self) -> Wait | None:
        """The delay after which the receiver uses each packet that it uses; None if this is not always the same."""
        return self.buffer or (None if self.delay is None else self.delay.constant)

    def played(self) -> LinkLaw:
        """Return the link without its constant delay. A packet that arrives later than the buffer counts as lost.

        A link whose delays are random, and whose receiver has no buffer, is returned as it is. If the link drops
        packets and acknowledges those that arrive, a sender learns only after the delay which packet was lost, so the
        delay remains one of the link, with a single value. It also remains, if only as 0, where acknowledgements are
        late.
        """
        law, buffer, after = self.delay, self.buffer, self._used_after
        if after is None and not (law is None and self.acknowledgement_delay):
            return self
        after = after or Wait()
        losses: float | LossLaw = self.burst or self.loss
        if law is not None and buffer is not None:
            losses = law.losses(buffer, self.loss, self.burst)
        lost = {"loss": losses, "burst": None} if isinstance(losses, float) else {"loss": 0.0, "burst": losses}
        seconds = after.seconds > 0
        single = DelayLaw((after.seconds if seconds else float(after.steps),), ((1.0,),), seconds)
        unknown = self.acknowledged and losses != 0.0
        return replace(self, delay=single if unknown else None, buffer=None, **lost)

    @property
    def protocol(self) -> str:
        """Protocol of the link: ``"ideal"`` (no losses), ``"tcp"`` (acknowledgements) or ``"udp"`` (no
        acknowledgements).
        """
        return "ideal" if self.acknowledged is None else "tcp" if self.acknowledged else "udp"

    def in_steps(self, step: float) -> LinkLaw:
        """Return the link with delays and buffer in steps instead of seconds, for a plant with such steps.

        Raises:
            ProblemError: one of them is no whole number of steps.
        """
        law, buffer = self.delay, self.buffer
        if law is not None and law.in_seconds:
            found = law.in_periods(step)
            if any(wait % 1.0 for wait in found.waits):
                raise ProblemError(_apart_from_steps("delay", law.text(), step))
            law = found
        if buffer is not None and buffer.seconds:
            periods = buffer.periods(step)
            if periods % 1.0:
                raise ProblemError(_apart_from_steps("buffer", buffer.text(), step))
            buffer = Wait(int(periods))
        return replace(self, delay=law, buffer=buffer)

    @property
    def intervals(self) -> dict[str, int | None]:
        """Smallest and largest allowed number of steps from one send to the next, by the name of the key."""
        return {"min_interval": self.min_interval, "max_interval": self.max_interval}

    def spending(self) -> str:
        """Describe price, energy, battery, limits on send intervals, delay and buffer, as far as they are given."""
        parts = [f"price {self.price:g}"] if self.price != 1.0 else []
        parts += [] if self.energy is None else [f"{self.energy:g} J per packet"]
        parts += [] if self.battery is None else [f"battery of {self.battery:g} J"]
        parts += [f"at least {number_of(self.min_interval, 'step')} between sends"] if self.min_interval > 1 else []
        parts += [] if self.max_interval is None else [f"at most {number_of(self.max_interval, 'step')} between sends"]
        return "".join(f"; {part}" for part in (*parts, *self.lateness()))

    def lateness(self) -> tuple[str, ...]:
        """Describe delay and buffer in words, as far as they are given."""
        parts = [] if self.delay is None else [f"delay {self.delay.text(self.states)}"]
        if self.buffer is not None:
            late = self.late
            lost = f", {percent(late)} never arrive or arrive later" if late else ""
            parts.append(f"a packet is used {self.buffer.text()} after it was sent{lost}")
        if self.acknowledgement_delay:
            parts.append("acknowledgements arrive one step late")
        return tuple(parts)

    @property
    def timed(self) -> bool:
        """Whether packets or their acknowledgements take time, or a buffer lets packets wait."""
        return self.delay is not None or self.buffer is not None or self.acknowledgement_delay > 0

    @property
    def states(self) -> tuple[float, ...]:
        """Share of the steps in each state of the link, one if it has no bursts."""
        return (1.0,) if self.burst is None else tuple(self.burst.start.tolist())

    @property
    def late(self) -> float:
        """Share of the packets that the law of delay loses, or that arrive later than the buffer."""
        if self.delay is None:
            return 0.0
        found = self.delay.later_than(self.buffer or self.delay.most)
        shares = self.states if len(found) > 1 else (1.0,)
        return float(np.dot(found, shares))

    @property
    def ideal(self) -> bool:
        """True if the link delivers every packet."""
        return self.acknowledged is None

    @property
    def mean_loss(self) -> float:
        """Loss probability of the link. If losses are bursty, it is that of the stationary distribution."""
        return self.loss if self.burst is None else self.burst.loss

    def power(self, rate: Estimate) -> Estimate | None:
        """Return the mean power in watts that sending needs at a rate in packets per second; None if no energy is
        given.
        """
        return None if self.energy is None else rate.scaled(self.energy)

    def life(self, rate: Estimate) -> Estimate | None:
        """Return the battery's life in seconds at a rate in packets per second; None if no battery is given.

        Example:
            >>> LinkLaw(energy=2e-3, battery=9000.0).life(Estimate(5.0, 0.0, "exact")).value
            900000.0
        """
        power = self.power(rate)
        return None if power is None or self.battery is None or rate.value == 0 else power.inverse(self.battery)

    def short(self) -> str:
        """Describe the protocol and the losses of the link in a few words."""
        played = self.played()
        told = f"{self.protocol}, drops {percent(played.mean_loss)}{' in bursts' if played.burst else ''}"
        return "; ".join((told, *self.lateness()))


def _apart_from_steps(name: str, told: str, step: float) -> str:
    return (
        f"{name} is {told}, but the plant is discrete in time; expected whole numbers of steps, or of the {step:g} s "
        "of plant.dt, or a plant that is continuous in time (omit plant.dt)"
    )


IDEAL_LINK = LinkLaw()


def usual_links(
    protocol: ProtocolName, payload: EncodingName, laws: Mapping[str, Mapping[str, Any]]
) -> dict[str, LinkLaw]:
    """Return the links of the default sensor and actuator. Error messages name their keys in ``[network]``."""
    if protocol not in ACKNOWLEDGED:
        raise ProblemError(f"network.protocol is {protocol!r}; expected 'udp', 'tcp' or 'ideal'")
    choice("network.payload", payload, ("float64", "float32", "int16"))
    found: dict[str, LinkLaw] = {}
    for link, law in reversed(tuple(laws.items())):
        loss = number(f"network.{link}_loss", law["loss"], 0.0, 1.0, closed=True)
        if law["burst"] is not None:
            instance(f"network.{link}_burst", law["burst"], LossLaw)
        if law["burst"] is not None and loss > 0:
            raise ProblemError(f"network.{link}_loss and network.{link}_burst are both given; expected one of them")
        if protocol == "ideal" and (loss > 0 or law["burst"] is not None):
            raise ProblemError(
                f"network.{link}_{'loss' if law['burst'] is None else 'burst'} is given for an ideal network; "
                "expected protocol = 'udp' or 'tcp' for a network with packet losses"
            )
        if law.get("battery") is not None and law.get("energy") is None:
            raise ProblemError(
                f"network.{link}_battery is given without network.{link}_energy; expected network.{link}_energy, the "
                "joules per packet"
            )
        try:
            found[link] = LinkLaw(**law, acknowledged=ACKNOWLEDGED[protocol], payload=payload)
        except ProblemError as error:
            raise ProblemError(f"network.{link}_{error}") from None
    return {link: found[link] for link in laws}
