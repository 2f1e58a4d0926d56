"""Cameras and eyes: what is measured, how well, and when nothing is."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from itertools import product

import numpy as np
import pytest
from counts import few
from twin.looks import camera_of, errors, true_calibration

from taciturn.errors import ProblemError
from taciturn_twins import _cv2, _mujoco
from taciturn_twins.body import Body
from taciturn_twins.calibration import Calibration
from taciturn_twins.camera import LARGEST, Camera
from taciturn_twins.catalogue import ROBOTS
from taciturn_twins.robot import HEIGHT, WIDTH, Robot
from taciturn_twins.vision import Eye

both = pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
ROVER, OMNI = ROBOTS["rover"], ROBOTS["omni"]


def pixels(picture: bytes) -> _cv2.Pixels:
    """Return a picture that must be one."""
    found = _cv2.read_picture(picture)
    assert found is not None
    return found


@pytest.mark.evidence
def test_a_picture_depends_on_seed_and_number_alone() -> None:
    """In any order of calls, and after the light was turned and turned back."""
    seen, camera = Body(ROVER).snapshot, Camera(ROVER, 5)
    first = [camera.take(seen, k) for k in range(3)]
    camera.lighting = 0.5
    assert camera.take(seen, 0) != first[0]
    camera.lighting = 1.0
    assert [camera.take(seen, k) for k in (2, 0, 1)] == [first[2], first[0], first[1]]
    assert len(set(first)) == 3
    camera.close()
    other = Camera(ROVER, 6)
    assert other.take(seen, 0) != first[0]
    other.close()


@both
def test_a_picture_is_a_jpeg_that_fits_a_packet(robot: Robot) -> None:
    """Of 640×480 pixels in colour, and at most 60 000 bytes in any light."""
    camera = camera_of(robot)
    for lighting in (0.0, 1.0, 3.0):
        camera.lighting = lighting
        picture = camera.take(Body(robot).snapshot)
        assert len(picture) <= LARGEST
        assert pixels(picture).shape == (HEIGHT, WIDTH, 3)


@pytest.mark.evidence
@pytest.mark.parametrize("scene", few(product(ROBOTS, [0.4, 1.0, 1.6]), 2, 2), ids=str)
def test_a_marker_is_found_wherever_it_is_in_dim_and_bright_light(scene: tuple[str, float]) -> None:
    """Required: within 3 mm in any light, through a lens that is known; never lost."""
    robot, lighting = ROBOTS[scene[0]], scene[1]
    found = errors(robot, true_calibration(robot), 12, lighting)
    assert len(found) == 12
    assert np.abs(found[:, :2]).max() < 3e-3
    if robot.turns:
        assert np.abs(found[:, 2]).max() < math.radians(1.5)


@both
def test_a_covered_marker_is_not_seen(robot: Robot) -> None:
    """Nor in the dark; uncovered and lit it is seen again."""
    camera, eye, seen = camera_of(robot), Eye(robot, true_calibration(robot)), Body(robot).snapshot
    assert eye.see(camera.take(seen)) is not None
    camera.covered = True
    assert eye.see(camera.take(seen)) is None
    camera.covered = False
    camera.lighting = 0.0
    assert eye.see(camera.take(seen)) is None
    camera.lighting = 1.0
    assert eye.see(camera.take(seen)) is not None


@both
def test_a_damaged_picture_is_none(robot: Robot) -> None:
    """Nothing, noise, another size, cut off: no exception, and something is drawn all the same.

    Bits that turn are the wire's: the checksum of a datagram.
    """
    camera, eye, random = camera_of(robot), Eye(robot, true_calibration(robot)), np.random.default_rng(0)
    whole = camera.take(Body(robot).snapshot)
    small = _cv2.write_jpeg(np.zeros((48, 64, 3), np.uint8), 85)
    for broken in (b"", b"not a picture", random.bytes(5000), small, whole[:300], whole[100:], b"\0" + whole[1:]):
        assert eye.see(broken) is None
        assert pixels(eye.draw(broken)).shape == (HEIGHT, WIDTH, 3)
    assert eye.see(whole) is not None


def test_what_is_pink_and_no_marker_is_not_believed() -> None:
    """Too large, too small, too long, off the track, or a second one."""
    calibration = true_calibration(ROVER)
    eye, camera = Eye(ROVER, calibration), camera_of(ROVER)
    clear = pixels(camera.take(Body(ROVER).snapshot))
    camera.covered = True
    empty = pixels(camera.take(Body(ROVER).snapshot))
    pink = (118, 16, 204)

    def with_pink(picture: _cv2.Pixels, x: float, y: float, wide: int, high: int) -> bytes:
        u, v = np.rint(calibration.see(np.array([[x, y, 0.0989]]))[0]).astype(int)
        changed = picture.copy()
        rows, columns = np.ogrid[:HEIGHT, :WIDTH]
        changed[((columns - u) / wide) ** 2 + ((rows - v) / high) ** 2 <= 1] = pink
        return _cv2.write_jpeg(changed, 95)

    right = eye.see(with_pink(empty, 0.3, 0.0, 11, 8))
    assert right is not None  # of this size it is the marker
    assert right[0] == pytest.approx(0.3, abs=3e-3)
    for x, y, wide, high in ((0.3, 0, 30, 22), (0.3, 0, 5, 4), (0.3, 0, 25, 3), (0.3, 0.3, 11, 8)):
        assert eye.see(with_pink(empty, x, y, wide, high)) is None
    assert eye.see(with_pink(clear, 0.2, 0.0, 11, 8)) is None
    near = eye.see(with_pink(clear, 0.3, 0.4, 9, 6))  # next to the track it does not disturb
    assert near is not None
    assert near[0] == pytest.approx(0.7, abs=3e-3)


def test_a_tag_of_another_size_or_number_is_not_believed() -> None:
    """The robot's own number at two thirds of its size and at more, and the tags of the field alone."""
    eye, camera = Eye(OMNI, true_calibration(OMNI)), camera_of(OMNI)
    camera.covered = True
    empty = pixels(camera.take(Body(OMNI).snapshot))
    assert sorted(_cv2.find_tags(empty)) == [0, 1, 2, 3, 4, 5]
    for cells, believed in ((6, True), (4, False), (8, False)):
        tag = np.pad(_cv2.draw_tag(7, 6 * cells), cells, constant_values=255)
        changed = empty.copy()
        changed[200 : 200 + len(tag), 300 : 300 + len(tag)] = tag[..., None]
        picture = _cv2.write_jpeg(changed, 95)
        assert 7 in _cv2.find_tags(pixels(picture))
        assert (eye.see(picture) is not None) == believed


@both
def test_what_is_seen_is_drawn_where_it_is(robot: Robot) -> None:
    """Green pixels around the marker, and none without it."""
    calibration, camera = true_calibration(robot), camera_of(robot)
    eye, body = Eye(robot, calibration), Body(robot)
    place = calibration.see(np.array([[*body.pose[:2], 0.1] if robot.turns else [body.pose[0], 0.0, 0.1]]))[0]

    def green(picture: bytes) -> int:
        left, top = (place - 40).astype(int)
        b, g, r = pixels(picture)[top : top + 80, left : left + 80].astype(int).transpose(2, 0, 1)
        return int(((g > 150) & (b < 110) & (r < 110)).sum())

    assert green(eye.draw(camera.take(body.snapshot))) > 20
    camera.covered = True
    assert green(eye.draw(camera.take(body.snapshot))) == 0


def test_impossible_pictures_are_refused() -> None:
    """Each by one sentence."""
    camera = camera_of(ROVER)
    with pytest.raises(ProblemError, match="expected"):
        camera.take([0.0, 1.0])
    with pytest.raises(ProblemError, match="expected"):
        camera.take(Body(ROVER).snapshot, -1)
    with pytest.raises(ProblemError, match="expected"):
        camera.lighting = -0.5
    with pytest.raises(ProblemError, match="lacks the entries translation"):
        Calibration.from_document({"K": np.eye(3).tolist(), "distortion": [0] * 4, "rotation": [0] * 3, "error": 0})


@pytest.mark.parametrize(
    "broken",
    few([{"__EGL_VENDOR_LIBRARY_FILENAMES": os.devnull}, {"MUJOCO_GL": "nonsense"}, {"MUJOCO_GL": "disable"}], 1),
    ids=lambda broken: next(iter(broken)),
)
def test_without_graphics_the_message_says_what_to_install(broken: dict[str, str]) -> None:
    """Where EGL finds no driver, or another platform is asked for that there is not; never a traceback of OpenGL."""
    text = (
        "from taciturn.errors import ProblemError\n"
        "from taciturn_twins.camera import Camera\n"
        "from taciturn_twins.catalogue import ROBOTS\n"
        "try:\n    Camera(ROBOTS['rover'])\n"
        "except ProblemError as error:\n    print(error)\n"
    )
    environment = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"} | broken
    run = subprocess.run(
        [sys.executable, "-c", text], env=environment, capture_output=True, text=True, check=False, timeout=120
    )
    assert run.returncode == 0, run.stderr
    assert "apt install libegl1 libgl1-mesa-dri" in run.stdout
    assert len(run.stdout.strip().splitlines()) == 1


@pytest.mark.parametrize("missing", ["mujoco", "cv2"])
def test_without_its_libraries_the_message_names_the_extra(missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo and OpenCV are one extra."""
    _cv2._cv2.cache_clear()
    _mujoco._mujoco.cache_clear()
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ProblemError, match=r"pip install 'taciturn\[twin\]'"):
        Camera(ROVER)
