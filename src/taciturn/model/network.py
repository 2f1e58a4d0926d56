"""The network between sensor, controller and actuator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np

from taciturn._arrays import Array, choice, count, instance, number
from taciturn._display import Displayed
from taciturn._text import percent
from taciturn.errors import ProblemError
from taciturn.model.wire import CODES, Encoding, EncodingName

ProtocolName = Literal["udp", "tcp", "ideal"]


@dataclass(frozen=True, repr=False)
class Burst(Displayed):
    """Gilbert–Elliott losses of a link with a good and a bad state; the initial state has the stationary distribution.

    Args:
        to_bad: probability per step of a transition from good to bad, in [0, 1].
        to_good: probability per step of a transition from bad to good, in [0, 1].
        loss_good: loss probability in the good state, in [0, 1].
        loss_bad: loss probability in the bad state, in [0, 1].

    Raises:
        ProblemError: if a probability is outside [0, 1].

    Source: gilbert1960, elliott1963
    """

    to_bad: float
    to_good: float
    loss_good: float
    loss_bad: float

    def __post_init__(self) -> None:
        """Check the ranges of the arguments."""
        for name in ("to_bad", "to_good", "loss_good", "loss_bad"):
            object.__setattr__(self, name, number(name, getattr(self, name), 0.0, 1.0, closed=True))

    @property
    def share_bad(self) -> float:
        """Stationary probability of the bad state; 0 for a link that remains in its initial good state."""
        turns = self.to_bad + self.to_good
        return 0.0 if turns == 0 else self.to_bad / turns

    @property
    def loss(self) -> float:
        """Stationary loss probability."""
        return (1 - self.share_bad) * self.loss_good + self.share_bad * self.loss_bad


@dataclass(frozen=True, repr=False)
class Network(Displayed):
    """A network of two links, from sensor to controller and from controller to actuator.

    Args:
        protocol: ``"udp"`` (without acknowledgement), ``"tcp"`` (with acknowledgement) or ``"ideal"``.
        actuator_loss: loss probability of a packet to the actuator, in [0, 1].
        sensor_loss: loss probability of a packet from the sensor, in [0, 1].
        delay: computation delay in steps, at least 0.
        actuator_burst: bursty losses instead of ``actuator_loss``.
        sensor_burst: bursty losses instead of ``sensor_loss``.
        payload: encoding of the numbers in a packet: ``"float64"`` (exact), or ``"float32"`` or ``"int16"`` (rounded).
        actuator_range: with ``"int16"``, full-scale value of packets to the actuator: one number, or one per entry.
        sensor_range: with ``"int16"``, full-scale value of packets from the sensor: one number, or one per entry.

    Raises:
        ProblemError: if a probability is outside [0, 1], an ideal network has losses, a link has both loss and burst,
            or a range is not positive or is given without ``"int16"``.
    """

    protocol: ProtocolName = "ideal"
    actuator_loss: float = 0.0
    sensor_loss: float = 0.0
    delay: int = 0
    actuator_burst: Burst | None = None
    sensor_burst: Burst | None = None
    payload: EncodingName = "float64"
    actuator_range: float | tuple[float, ...] | None = None
    sensor_range: float | tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        """Check the ranges of the arguments."""
        if self.protocol not in ("udp", "tcp", "ideal"):
            raise ProblemError(f"network.protocol is {self.protocol!r}; expected 'udp', 'tcp' or 'ideal'")
        count("network.delay", self.delay, 0)
        for link in ("actuator", "sensor"):
            loss = number(f"network.{link}_loss", getattr(self, f"{link}_loss"), 0.0, 1.0, closed=True)
            object.__setattr__(self, f"{link}_loss", loss)  # a float even if the integer 0 was given
            burst = getattr(self, f"{link}_burst")
            if burst is not None:
                instance(f"network.{link}_burst", burst, Burst)
            if burst is not None and loss > 0:
                raise ProblemError(f"network.{link}_loss and network.{link}_burst are both given; expected one of them")
            if self.protocol == "ideal" and (loss > 0 or burst is not None):
                raise ProblemError(
                    f"network.{link}_{'loss' if burst is None else 'burst'} is given for an ideal network; "
                    "expected protocol = 'udp' or 'tcp' for a network with packet losses"
                )
        self._check_payload()

    def _check_payload(self) -> None:
        choice("network.payload", self.payload, CODES)
        for link in ("actuator", "sensor"):
            given = getattr(self, f"{link}_range")
            if given is None:
                continue
            name = f"network.{link}_range"
            if self.payload != "int16":
                raise ProblemError(
                    f"{name} is given with payload = {self.payload!r}; expected a range with 'int16' only"
                )
            entries = cast("Sequence[object]", given if isinstance(given, list | tuple) else (given,))
            checked = tuple(number(name, entry, 0.0) for entry in entries)
            object.__setattr__(self, f"{link}_range", checked)

    def short(self) -> str:
        """Return the protocol, losses, delay and encoding of the network as text."""
        if self.protocol == "ideal":
            text = "ideal: every packet arrives"
        else:
            told = "acknowledged" if self.protocol == "tcp" else "no acknowledgement"
            losses = [
                f"{link} drops {percent(self.loss(link))}{' in bursts' if self.burst(link) else ''}"
                for link in ("actuator", "sensor")
            ]
            text = f"{self.protocol} ({told}); {', '.join(losses)}"
        if self.delay:
            text += f"; {self.delay} step{'s' * (self.delay > 1)} of delay"
        return text + (f"; numbers as {self.payload}" if self.payload != "float64" else "")

    def encoding(self, link: str) -> Encoding:
        """Return the encoding of the payloads of a link.

        Raises:
            ProblemError: if the payload is ``"int16"`` and the link has no range.
        """
        if self.payload != "int16":
            return Encoding(self.payload)
        scale = {"actuator": self.actuator_range, "sensor": self.sensor_range}[link]
        if scale is None:
            raise ProblemError(
                f"network.{link}_range is missing, but network.payload is 'int16'; expected the largest absolute "
                "value of "
                f"the numbers in a packet of the {link} link"
            )
        return Encoding("int16", cast("tuple[float, ...]", scale))

    def given(self, link: str) -> list[str]:
        """Return the names of the properties of a link that differ from those of an ideal link."""
        names = [f"{link}_{what}" for what in ("loss", "burst", "range")]
        return [name for name in names if getattr(self, name) != getattr(IDEAL, name)]

    def burst(self, link: str) -> Burst | None:
        """Return the burst model of a link, or None if its loss probability is constant.

        The loss probability is also constant if the link never leaves its initial state.
        """
        burst = self._given_burst(link)
        return None if burst is None or burst.share_bad in (0.0, 1.0) else burst

    def loss(self, link: str) -> float:
        """Return the loss probability of a link; for bursty losses, the stationary loss probability."""
        burst = self._given_burst(link)
        return {"actuator": self.actuator_loss, "sensor": self.sensor_loss}[link] if burst is None else burst.loss

    def _given_burst(self, link: str) -> Burst | None:
        return {"actuator": self.actuator_burst, "sensor": self.sensor_burst}[link]

    def outage(self, link: str) -> float:
        """Return the long-run probability that a link drops a packet, given that it has dropped all packets before."""
        turns, losses = self.chain(link)
        return float(np.abs(np.linalg.eigvals(turns * losses)).max())

    def chain(self, link: str) -> tuple[Array, Array]:
        """Return the transition probabilities between the states of a link, (s, s), and the loss in each state, (s,).

        A link with a constant loss probability has one state; otherwise the states are good and bad.
        """
        burst = self.burst(link)
        if burst is None:
            return np.ones((1, 1)), np.array([self.loss(link)])
        turns = np.array([[1 - burst.to_bad, burst.to_bad], [burst.to_good, 1 - burst.to_good]])
        return turns, np.array([burst.loss_good, burst.loss_bad])

    def without_bursts(self) -> Network:
        """Return the network with independent losses of the same mean probability on each link."""
        return replace(
            self,
            actuator_loss=self.loss("actuator"),
            sensor_loss=self.loss("sensor"),
            actuator_burst=None,
            sensor_burst=None,
        )

    def without_constant_bursts(self) -> Network:
        """Return the network in which a burst model that never changes its state is a loss probability."""
        constant = [f"{link}_" for link in ("actuator", "sensor") if self._given_burst(link) and not self.burst(link)]
        changes = {f"{link}loss": self.loss(link[:-1]) for link in constant}
        return replace(self, **{**dict.fromkeys(f"{link}burst" for link in constant), **changes}) if constant else self

    def without_rounding(self) -> Network:
        """Return the network whose packets transmit numbers without rounding."""
        return replace(self, payload="float64", actuator_range=None, sensor_range=None)


IDEAL = Network()
