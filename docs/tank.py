"""Draw the picture of the README, ``tank.svg``: a tank with event-triggered and with periodic control.

``taciturn simulate --plot`` also shows the valve and the trigger; this picture shows only what a first look compares.
"""

from __future__ import annotations

import re
from pathlib import Path

import taciturn
from taciturn.extend import Lane, Panel, Series, draw

STEPS = 300
WIDTH = 900  # pixels, more than a page is wide, so that the picture fills it


def picture() -> str:
    """Return the picture as SVG; what is behind it shows through, as the page may be light or dark."""
    problem = taciturn.load("pid-tank").changed({"theta": 0.8})
    own = taciturn.simulate(problem.close(problem.design()), STEPS, versus="periodic")
    assert own.versus is not None
    levels, lanes = list[Series](), list[Lane]()
    for path, name, thing in ((own, "Taciturn", "policy"), (own.versus, "fixed steps", "periodic control")):
        sent = path.sends["actuator"]
        level = path.state @ path.loop.problem.plant.C[0]
        levels.append(Series(path.time.tolist(), level.tolist(), f"{name}: cost {path.cost:.4f}", thing=thing))
        lanes.append(Lane(name, path.time[sent].tolist(), note=f"{sent.sum()} packets"))
    panels = [
        Panel(levels, ylabel="level", height=1.9),
        Panel(lanes=lanes, xlabel=f"time ({own.unit})", step=own.step),
    ]
    figure = draw(panels, figsize=(5.8, 3.1))
    for part in (figure, *figure.axes):
        part.patch.set_visible(False)
    return re.sub(r'width="[\d.]+pt" height="[\d.]+pt"', f'width="{WIDTH}"', figure.svg(), count=1)


if __name__ == "__main__":
    Path(__file__).with_suffix(".svg").write_text(picture(), encoding="utf-8")
