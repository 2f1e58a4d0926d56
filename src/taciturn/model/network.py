"""The network between sensor, controller and actuator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from taciturn._arrays import count, instance, number
from taciturn.errors import ProblemError

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

    Raises:
        ProblemError: a probability outside [0, 1], losses on an ideal network, loss and burst on one link.
    """

    protocol: ProtocolName = "ideal"
    actuator_loss: float = 0.0
    sensor_loss: float = 0.0
    delay: int = 0
    actuator_burst: Burst | None = None
    sensor_burst: Burst | None = None

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

    def burst(self, link: str) -> Burst | None:
        """Return the bursts of a link, or None where its loss probability is constant."""
        return {"actuator": self.actuator_burst, "sensor": self.sensor_burst}[link]

    def loss(self, link: str) -> float:
        """Return the loss probability of a link: constant, or the stationary one of its bursts."""
        burst = self.burst(link)
        return {"actuator": self.actuator_loss, "sensor": self.sensor_loss}[link] if burst is None else burst.loss

    def without_bursts(self) -> Network:
        """Return the network that loses as much on each link, without memory."""
        return replace(
            self,
            actuator_loss=self.loss("actuator"),
            sensor_loss=self.loss("sensor"),
            actuator_burst=None,
            sensor_burst=None,
        )
