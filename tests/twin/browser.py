"""A headless Chromium for the pages of runs, and a command that takes their pictures.

``python tests/twin/browser.py URL OUT.png [--ticks 100] [--size 1280x800] [--dark]`` waits until the page at a URL has
so many steps of a round. It needs Chromium, as of Debian's package, and Playwright, as of pip.
"""

from __future__ import annotations

import argparse
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
)  # fmt: skip


def missing() -> str:
    """Return what is missing for a browser, as a sentence; empty: nothing is."""
    try:
        import playwright  # noqa: F401
    except ImportError:
        return "playwright is not installed; expected it for tests of the page: pip install playwright"
    if not any(map(shutil.which, NAMES)):
        return f"none of the programs {', '.join(NAMES)} is there; expected one: apt-get install chromium"
    return ""


@contextmanager
def browse() -> Iterator[Any]:
    """Yield a browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        found = next(path for path in map(shutil.which, NAMES) if path)
        browser = playwright.chromium.launch(executable_path=found, args=list(FLAGS))
        try:
            yield browser
        finally:
            browser.close()


def await_true(tab: Any, expression: str, patience: float = 8.0) -> None:
    """Wait until an expression holds on a page; ``wait_for_function`` would need a page that permits ``eval``."""
    end = time.monotonic() + patience
    while not tab.evaluate(expression):
        assert time.monotonic() < end, f"{expression} does not hold"
        tab.wait_for_timeout(20)


def await_ticks(tab: Any, count: int, patience: float = 8.0) -> None:
    """Wait until a page has drawn so many steps of a round."""
    await_true(tab, f"+document.body?.dataset.rows >= {count}", patience)


def main() -> None:
    """Take a picture."""
    parser = argparse.ArgumentParser(description="take a picture of the page of a run")
    parser.add_argument("url")
    parser.add_argument("out")
    parser.add_argument("--ticks", type=int, default=100, help="of a round that are to be there")
    parser.add_argument("--size", default="1280x800")
    parser.add_argument("--dark", action="store_true")
    parser.add_argument("--patience", type=float, default=300.0, help="seconds to wait for the steps")
    given = parser.parse_args()
    if lacks := missing():
        raise SystemExit(lacks)
    width, height = map(int, given.size.split("x"))
    with browse() as browser:
        scheme = "dark" if given.dark else "light"
        tab = browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme)
        tab.goto(given.url, wait_until="commit")
        await_ticks(tab, given.ticks, given.patience)
        tab.screenshot(path=given.out, full_page=width < 800)


if __name__ == "__main__":
    main()
