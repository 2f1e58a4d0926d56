"""The pictures of the page in the manual.

``python tests/explore/picture.py docs/explore.webp [PROBLEM] [--dark]`` takes one of the answers, and
``python tests/explore/picture.py docs/recording.webp --recording omni.nc`` one of the record of a run.
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path

from PIL import Image
from twin.browser import browse

from taciturn_explore.recording import read_recording
from taciturn_explore.server import open_page, open_recording
from taciturn_explore.setting import setting_for

SIZE = {"width": 1280, "height": 800}
HERE = ("127.0.0.1", 0)
SCALE = 1.5  # pixels of the picture for each of the page


def main() -> None:
    """Take the picture when the page has all its answers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("problem", nargs="?", default="two-mass")
    parser.add_argument("--dark", action="store_true")
    parser.add_argument("--recording", type=Path)
    asked = parser.parse_args()
    record = None if asked.recording is None else read_recording([asked.recording], None)
    served = open_page(*setting_for(asked.problem), HERE) if record is None else open_recording(record, HERE)
    with served, browse() as browser:
        scheme = "dark" if asked.dark else "light"
        tab = browser.new_page(viewport=SIZE, color_scheme=scheme, device_scale_factor=SCALE)
        tab.goto(served.url)
        if record is None:
            tab.wait_for_selector(".explore[data-refined=true]")
            tab.wait_for_selector(".busy:not(.on)", state="attached", timeout=120_000)
        else:
            tab.locator("svg.run").hover()
        picture = Image.open(io.BytesIO(tab.screenshot(full_page=True)))
        picture.save(asked.out, quality=48, method=6)


if __name__ == "__main__":
    main()
