"""The network between sensor, controller and actuator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np

from taciturn._arrays import choice, count, instance, number
from taciturn.errors import ProblemError
from taciturn.model.wire import CODES, Encoding, EncodingName

ProtocolName = Literal["udp", "tcp", "ideal"]


@dataclass(frozen=True)
class Burst:
    """Gilbert–Elliott losses: a link that is now good, now bad; its first state is drawn from the stationary law.

    Args:
        to_bad: probability per step of turning bad, in [0, 1].
        to_good: probability per step of turning good, in [0, 1].
        loss_good: loss probability while good, in [0, 1].
        loss_bad: loss probability while bad, in [0, 1].

    Raises:
        ProblemError: a probability outside [0, 1].

    Source: gilbert1960, elliott1963
    """

    to_bad: float
    to_good: float
    loss_good: float
    loss_bad: float

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in ("to_bad", "to_good", "loss_good", "loss_bad"):
            object.__setattr__(self, name, number(name, getattr(self, name), 0.0, 1.0, closed=True))

    @property
    def share_bad(self) -> float:
        """Stationary probability of the bad state; 0 for a link that never turns, which starts good."""
        turns = self.to_bad + self.to_good
        return 0.0 if turns == 0 else self.to_bad / turns

    @property
    def loss(self) -> float:
        """Stationary loss probability."""
        return (1 - self.share_bad) * self.loss_good + self.share_bad * self.loss_bad


@dataclass(frozen=True)
class Network:
    """Two links, sensor → controller and controller → actuator.

    Args:
        protocol: ``"udp"`` (no acknowledgement), ``"tcp"`` (acknowledged) or ``"ideal"``.
        actuator_loss: loss probability of a packet to the actuator, in [0, 1].
        sensor_loss: loss probability of a packet from the sensor, in [0, 1].
        delay: steps of computation delay, at least 0.
        actuator_burst: bursty losses instead of ``actuator_loss``.
        sensor_burst: bursty losses instead of ``sensor_loss``.
        payload: how the numbers in a packet are written: ``"float64"``, ``"float32"`` or ``"int16"``, which round them.
        actuator_range: with ``"int16"``, the largest number that a packet to the actuator holds: one, or one per entry.
        sensor_range: that of a packet from the sensor.

    Raises:
        ProblemError: a probability outside [0, 1], losses on an ideal network, loss and burst on one link, or a range
            that is not positive or that ``payload`` has no use for.
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
        """Check the ranges."""
        if self.protocol not in ("udp", "tcp", "ideal"):
            raise ProblemError(f"network.protocol is {self.protocol!r}; expected 'udp', 'tcp' or 'ideal'")
        count("network.delay", self.delay, 0)
        for link in ("actuator", "sensor"):
            loss = number(f"network.{link}_loss", getattr(self, f"{link}_loss"), 0.0, 1.0, closed=True)
            object.__setattr__(self, f"{link}_loss", loss)  # a float also where 0 was given
            burst = getattr(self, f"{link}_burst")
            if burst is not None:
                instance(f"network.{link}_burst", burst, Burst)
            if burst is not None and loss > 0:
                raise ProblemError(f"network.{link}_loss and network.{link}_burst are both given; expected one of them")
            if self.protocol == "ideal" and (loss > 0 or burst is not None):
                raise ProblemError(
                    f"network.{link}_{'loss' if burst is None else 'burst'} is given for an ideal network; "
                    "expected protocol = 'udp' or 'tcp' where packets are lost"
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
                raise ProblemError(f"{name} is given with payload = {self.payload!r}; expected it with 'int16' only")
            entries = cast("Sequence[object]", given if isinstance(given, list | tuple) else (given,))
            checked = tuple(number(name, entry, 0.0) for entry in entries)
            object.__setattr__(self, f"{link}_range", checked)

    def encoding(self, link: str) -> Encoding:
        """Return how the payloads of a link are written.

        Raises:
            ProblemError: whole numbers without the range that they stand for.
        """
        if self.payload != "int16":
            return Encoding(self.payload)
        scale = {"actuator": self.actuator_range, "sensor": self.sensor_range}[link]
        if scale is None:
            raise ProblemError(
                f"network.{link}_range is missing, and network.payload is 'int16'; expected the largest number that "
                f"a packet of the {link} link is to hold"
            )
        return Encoding("int16", cast("tuple[float, ...]", scale))

    def given(self, link: str) -> list[str]:
        """Return the names of the properties of a link that are not those of an ideal one."""
        names = [f"{link}_{what}" for what in ("loss", "burst", "range")]
        return [name for name in names if getattr(self, name) != getattr(IDEAL, name)]

    def burst(self, link: str) -> Burst | None:
        """Return the bursts of a link, or None where its loss probability is constant."""
        return {"actuator": self.actuator_burst, "sensor": self.sensor_burst}[link]

    def loss(self, link: str) -> float:
        """Return the loss probability of a link: constant, or the stationary one of its bursts."""
        burst = self.burst(link)
        return {"actuator": self.actuator_loss, "sensor": self.sensor_loss}[link] if burst is None else burst.loss

    def outage(self, link: str) -> float:
        """Return the probability, in the long run, with which a link that has lost every packet loses the next one."""
        burst = self.burst(link)
        if burst is None:
            return self.loss(link)
        turns = np.array([[1 - burst.to_bad, burst.to_bad], [burst.to_good, 1 - burst.to_good]])
        lost = turns * [burst.loss_good, burst.loss_bad]
        return float(np.abs(np.linalg.eigvals(lost)).max())

    def without_bursts(self) -> Network:
        """Return the network that loses as much on each link, without memory."""
        return replace(
            self,
            actuator_loss=self.loss("actuator"),
            sensor_loss=self.loss("sensor"),
            actuator_burst=None,
            sensor_burst=None,
        )

    def without_rounding(self) -> Network:
        """Return the network whose packets hold numbers as they are."""
        return replace(self, payload="float64", actuator_range=None, sensor_range=None)


IDEAL = Network()
