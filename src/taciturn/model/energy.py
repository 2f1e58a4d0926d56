"""Energy that a node spends on a packet, and the energy of its battery."""

from __future__ import annotations

from dataclasses import dataclass

from taciturn._arrays import number
from taciturn._display import Displayed
from taciturn.errors import ProblemError
from taciturn.model.estimate import Estimate
from taciturn.model.steps import LinkName


@dataclass(frozen=True, repr=False)
class PacketEnergy(Displayed):
    """Energy in joules per packet of each link, and of the battery that supplies the sender.

    Args:
        sensor: energy of a packet on the sensor link.
        actuator: energy of a packet on the actuator link.
        sensor_battery: energy of the battery of the node that sends on the sensor link.
        actuator_battery: energy of the battery of the node that sends on the actuator link.

    Raises:
        ProblemError: an energy is not positive, or a battery is given without the energy of a packet.

    Example:
        >>> PacketEnergy(actuator=2e-3, actuator_battery=9000.0).life("actuator", Estimate(5.0, 0.0, "exact")).value
        900000.0
    """

    sensor: float | None = None
    actuator: float | None = None
    sensor_battery: float | None = None
    actuator_battery: float | None = None

    def __post_init__(self) -> None:
        """Check the energies."""
        for link in ("sensor", "actuator"):
            for name, value in ((f"{link}_energy", getattr(self, link)), (f"{link}_battery", self.battery(link))):
                if value is not None:
                    number(f"network.{name}", value, 0.0)
            if self.battery(link) is not None and getattr(self, link) is None:
                raise ProblemError(
                    f"network.{link}_battery is given without network.{link}_energy; expected the joules per packet"
                )

    def battery(self, link: str) -> float | None:
        """Return the energy of the battery of a link's sender, or None."""
        value: float | None = getattr(self, f"{link}_battery")
        return value

    def links(self) -> tuple[LinkName, ...]:
        """Return the links with an energy per packet."""
        given: tuple[tuple[LinkName, float | None], ...] = (("sensor", self.sensor), ("actuator", self.actuator))
        return tuple(link for link, value in given if value is not None)

    def power(self, link: str, rate: Estimate) -> Estimate:
        """Return the mean power in watts at a rate in packets per second."""
        return rate.scaled(getattr(self, link))

    def life(self, link: str, rate: Estimate) -> Estimate | None:
        """Return the seconds until the battery is empty at a rate in packets per second; None without a battery."""
        battery = self.battery(link)
        return None if battery is None or rate.value == 0 else self.power(link, rate).inverse(battery)
