"""Made-up rounds of a rover and of an omni robot: smooth paths, sends by a rule, losses by a count; no control."""

from __future__ import annotations

import io
import math
from typing import Any

from PIL import Image, ImageDraw

from taciturn_twins.page import About

LINKS = ("sensor", "actuator")
PRICE = "price per packet, in units of the cost; a higher price means fewer packets"
ROVER = About(
    "rover", "remote-lqg", 0.3, 120, ("x [m]",), ("torque [Nm]",), LINKS, (0.2, 0.0), 2.5, (),
    ("price", 0.0, 0.1), PRICE, 0.01, 1,
)  # fmt: skip
CIRCLE = tuple((0.8 * math.cos(k / 40), 0.6 * math.sin(k / 20)) for k in range(252))
OMNI = About(
    "omni", "lossy-lqg", 0.05, 252, ("x [m]", "y [m]", "heading [rad]"), ("v_x [m/s]", "v_y [m/s]", "ω [rad/s]"),
    LINKS, (0.2, 0.1), None, CIRCLE, ("theta", 0.001, 10.0), "theta is a share (no unit)", 0.5, 3,
)  # fmt: skip


def rows(about: About, count: int) -> list[dict[str, Any]]:
    """Return so many steps of a round."""
    found: list[dict[str, Any]] = []
    sends, drops = dict.fromkeys(about.links, 0), dict.fromkeys(about.links, 0)
    for k in range(count):
        if about.robot == "omni":
            x, y = about.reference[k % len(about.reference)]
            state = [x + 0.05 * math.sin(k / 9), y + 0.04 * math.cos(k / 7), 0.2 * math.sin(k / 30)]
            inputs = [math.sin(k / 20), math.cos(k / 15), 0.3 * math.sin(k / 5)]
        else:
            state, inputs = [0.7 * math.exp(-k / 30) + 0.01 * math.sin(k)], [-0.4 * math.exp(-(k // 9) / 4)]
        sent = {"sensor": int(k % 3 == 0), "actuator": int(k % 9 == 0)}
        arrived = {"sensor": int(sent["sensor"] and k % 5 != 0), "actuator": sent["actuator"]}
        sends = {link: sends[link] + sent[link] for link in about.links}
        drops = {link: drops[link] + sent[link] - arrived[link] for link in about.links}
        found.append({
            "tick": k, "time": k * about.tick, "state": state, "input": inputs,
            "estimate": None if 20 <= k < 24 else [value + 0.02 * math.sin(k / 4) for value in state],
            "trigger": 0.1 * (k % 9) ** 4 / 4096, "threshold": 0.05 if k % 50 else None,
            "sent": sent, "arrived": arrived, "packets": sends, "drops": drops,
            "cost": 2.0 * (1 - math.exp(-k / 40)), "degraded": int(60 <= k < 70),
        })  # fmt: skip
    return found


def every_sample(about: About, count: int) -> list[dict[str, Any]]:
    """Return so many steps of the loop that sends every sample."""
    return [
        {"tick": k, "state": [0.9 * x for x in row["state"]], "cost": 0.8 * row["cost"],
         "packets": dict.fromkeys(about.links, k + 1)}
        for k, row in enumerate(rows(about, count))
    ]  # fmt: skip


def picture(about: About, row: dict[str, Any], size: tuple[int, int] = (320, 240)) -> bytes:
    """Return a drawing of where the robot is, as a JPEG."""
    image = Image.new("RGB", size, (120, 124, 118))
    x, y = (row["state"] + [0.0])[:2] if about.robot == "omni" else (row["state"][0], 0.0)
    across, down = size[0] / 2 + 120 * x, size[1] / 2 - 120 * y
    draw = ImageDraw.Draw(image)
    draw.rectangle((across - 22, down - 14, across + 22, down + 14), fill=(178, 40, 40))
    draw.ellipse((across - 9, down - 9, across + 9, down + 9), outline=(255, 0, 255), width=3)
    out = io.BytesIO()
    image.save(out, "JPEG", quality=80)
    return out.getvalue()
