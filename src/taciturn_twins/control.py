"""The camera as a sensor of the controller, which converts each received picture to a measurement of the pose."""

from __future__ import annotations

import json
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from taciturn.errors import ProblemError
from taciturn.extend import number_of, read_text, write_whole
from taciturn.model.network import Network
from taciturn.model.policy import Policy
from taciturn.nodes.keys import Keys
from taciturn.nodes.packet import Packet
from taciturn_twins.calibration import Calibration
from taciturn_twins.catalogue import find_robot
from taciturn_twins.robot import Robot
from taciturn_twins.vision import Eye
from taciturn_twins.wire import PictureWire
from taciturn_udp.logs import logged

LARGEST = 2**20  # bytes of a calibration


def write_calibration(path: Path, robot: Robot, calibration: Calibration) -> None:
    """Write a calibration to a file, which the process of the controller reads."""
    path.write_text(json.dumps({"robot": robot.name, **calibration.document()}), encoding="utf-8")


def read_eye(path: Path) -> Eye:
    """Read a calibration from a file, and return an image processor that uses it.

    Raises:
        ProblemError: the file is missing, or contains no valid calibration.
    """
    try:
        held: dict[str, Any] = json.loads(read_text(path, LARGEST))
        return Eye(find_robot(held.pop("robot")), Calibration.from_document(held))
    except ProblemError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ProblemError(
            f"the calibration {path} cannot be read ({error!r}); expected a file written by a camera calibration"
        ) from None


@contextmanager
def wire_of_pictures(
    policy: Policy,
    network: Network,
    key: bytes | Keys | None,
    calibration: Path,
    *,
    seen: str | None = None,
    watch: Path | None = None,
) -> Generator[PictureWire]:
    """Provide a decoder that converts each received picture to a measurement.

    Args:
        policy: policy of the controller.
        network: network, which defines the rounding of packets.
        key: key that authenticates the packets.
        calibration: calibration file of the camera.
        seen: target of a JSON line per picture, as in ``taciturn_udp.logs.logged``.
        watch: file for the newest picture of the first loop, with the detected marker.

    Raises:
        ProblemError: the file is missing or contains no valid calibration, or the number of measured outputs differs
            from that of the policy.
    """
    eye = read_eye(calibration)
    measured, outputs = len(eye.robot.states), policy.model.outputs
    if measured != outputs:
        raise ProblemError(
            f"the calibration is for the {eye.robot.name}, whose camera measures {number_of(measured, 'number')}; "
            f"expected {number_of(outputs, 'number')}, as for the policy"
        )
    with logged(seen) as told:

        def tell(packet: Packet, picture: bytes, values: Sequence[float] | None) -> None:
            if told is not None:
                line = {"tick": packet.tick, "loop": packet.loop, "sequence": packet.sequence}
                told({**line, "seen": None if values is None else list(values)})
            if watch is not None and packet.loop == 0:
                write_whole(watch, eye.draw(picture))

        def see(picture: bytes) -> Sequence[float] | None:
            found = eye.see(picture)
            return None if found is None else found.tolist()

        yield PictureWire(policy, see, network, key, tell)
