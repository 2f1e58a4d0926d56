"""Latency of the page of ``taciturn explore`` in Chromium, and its memory over many moves.

    python benchmarks/explore.py [PROBLEM …] [--pages 4] [--chromium /usr/bin/chromium]
    python benchmarks/explore.py [PROBLEM …] --minutes 60

The first command measures the first picture, and the answers to twenty moves. A move presses an arrow key on the point.
Its latency is the time until the page shows the coarse point of the new setting: the attribute ``data-setting`` of the
page has changed. With several pages, all move at the same time.

The second one moves the point up and down its curve for so many minutes. Every two minutes it prints the memory of the
server, of its workers and of the page: resident MiB, and MiB of the page's heap after a collection.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import os
import platform
import shutil
import time
from pathlib import Path

import numpy as np
from playwright.async_api import Page, async_playwright

from taciturn_explore.server import open_page
from taciturn_explore.setting import setting_for

MOVES = 20
TOLD = 2.0  # minutes between two lines about the memory
WATCH = """
window.shown = [];
new MutationObserver(() => window.shown.push([performance.now(), document.querySelector('.explore').dataset.setting]))
  .observe(document.getElementById('explore'), {attributes: true, subtree: true, attributeFilter: ['data-setting']});
document.addEventListener('keydown', () => { window.pressed = performance.now(); }, true);
"""


def processor() -> str:
    """Return the name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


async def first_picture(page: Page, url: str) -> float:
    """Open the page, and return the milliseconds from the loaded page to its first point."""
    await page.add_init_script("addEventListener('DOMContentLoaded', () => {" + WATCH + "})")
    await page.goto(url)
    await page.wait_for_selector(".explore[data-setting]")
    return float(await page.evaluate("shown[0][0] - performance.getEntriesByType('navigation')[0].loadEventEnd"))


async def move(page: Page, key: str) -> float:
    """Move the point, and return the milliseconds until the page shows the coarse point."""
    before = await page.evaluate("shown.length")
    await page.locator(".handle").press(key)
    deadline = time.monotonic() + 20
    while await page.evaluate("shown.length") == before:
        if time.monotonic() > deadline:
            raise TimeoutError("no answer")
        await asyncio.sleep(0.005)
    return float(await page.evaluate(f"shown[{before}][0] - pressed"))


async def measure(problem: str, pages: int, chromium: str, moves: int) -> dict[str, object]:
    """Return the latencies of a problem on several pages."""
    begin, trusted = setting_for(problem)
    served = await asyncio.to_thread(open_page, begin, trusted, ("127.0.0.1", 0))
    try:
        async with async_playwright() as playwright:
            browser = await playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
            await asyncio.sleep(2.0)  # the workers start
            context = await browser.new_context()
            opened = [await context.new_page() for _ in range(pages)]
            first = await asyncio.gather(*(first_picture(page, served.url) for page in opened))
            for page in opened:
                await page.wait_for_selector(".explore[data-refined=true]")

            async def moved(page: Page) -> list[float]:
                found = list[float]()
                for i in range(moves):
                    found.append(await move(page, "ArrowLeft" if i < moves / 2 else "ArrowRight"))
                    await asyncio.sleep(0.15)
                return found

            found = np.concatenate(await asyncio.gather(*map(moved, opened)))
            await browser.close()
    finally:
        await asyncio.to_thread(served.close)
    low, middle, high, most = np.quantile(found, (0.1, 0.5, 0.9, 1.0))
    times = {"10%": low, "50%": middle, "90%": high, "most": most}
    return {"problem": problem, "pages": pages, "first_ms": round(max(first)), "moves": len(found)} | {
        f"move_ms_{name}": round(float(value)) for name, value in times.items()
    }


def resident(process: int) -> float:
    """Return the resident memory of a process in MiB."""
    lines = Path(f"/proc/{process}/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) / 1024


async def endure(problem: str, minutes: float, chromium: str) -> None:
    """Move the point for so many minutes, and print the memory and the number of moves now and then."""
    begin, trusted = setting_for(problem)
    served = await asyncio.to_thread(open_page, begin, trusted, ("127.0.0.1", 0))
    try:
        async with async_playwright() as playwright:
            browser = await playwright.chromium.launch(
                executable_path=chromium,
                args=["--no-sandbox", "--js-flags=--expose-gc", "--enable-precise-memory-info"],
            )
            page = await browser.new_page()
            await first_picture(page, served.url)
            workers = [one.pid for one in multiprocessing.active_children() if one.pid is not None]
            began, moves, told = time.monotonic(), 0, 0
            while (passed := (time.monotonic() - began) / 60) < minutes:
                await move(page, "ArrowLeft" if moves // MOVES % 2 else "ArrowRight")
                moves += 1
                await asyncio.sleep(2.0 if moves % MOVES == 0 else 0.1)  # now and then the answers are refined
                if passed >= told:
                    told += TOLD
                    heap = await page.evaluate("shown.length = 0, gc(), performance.memory.usedJSHeapSize / 2 ** 20")
                    found = {
                        "problem": problem,
                        "minutes": round(passed, 1),
                        "moves": moves,
                        "server_mib": round(resident(os.getpid())),
                        "workers_mib": [round(resident(one)) for one in workers],
                        "page_mib": round(heap, 1),
                    }
                    print(json.dumps(found), flush=True)
            await browser.close()
    finally:
        await asyncio.to_thread(served.close)


def main() -> None:
    """Measure, and print one line of JSON for each problem and number of pages."""
    parser = argparse.ArgumentParser()
    parser.add_argument("problems", nargs="*", default=["two-mass", "pid-tank", "quadruple-tank"])
    parser.add_argument("--pages", type=int, default=4)
    parser.add_argument("--minutes", type=float)
    parser.add_argument("--moves", type=int, default=MOVES)
    parser.add_argument("--chromium", default=shutil.which("chromium") or shutil.which("google-chrome"))
    asked = parser.parse_args()
    print(json.dumps({"processor": processor()}))
    for problem in asked.problems:
        if asked.minutes:
            asyncio.run(endure(problem, asked.minutes, asked.chromium))
            continue
        for pages in dict.fromkeys((1, asked.pages)):
            print(json.dumps(asyncio.run(measure(problem, pages, asked.chromium, asked.moves))), flush=True)


if __name__ == "__main__":
    main()
