"""The widget in JupyterLab and in marimo, in a headless Chromium: its numbers are those of the library, digit by digit.

Each server is started here, on a free port of the loopback, with folders that are thrown away. VS Code cannot be driven
by a browser, so nothing is shown of it.
"""

from __future__ import annotations

import json
import os
import secrets
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from explore.test_page_in_a_browser import evaluated, written

pytestmark = pytest.mark.evidence
CELL = 'import taciturn\nwidget = taciturn.explore("two-mass")\nwidget'
MARIMO = f"""import marimo

app = marimo.App()


@app.cell
def _():
    {CELL.replace(chr(10), chr(10) + "    ")}
    return


if __name__ == "__main__":
    app.run()
"""
TOKEN = secrets.token_hex(16)
STARTED = 90.0  # seconds in which a server answers
PATIENCE = 180_000  # milliseconds in which a widget shows a refined point


@contextmanager
def served(folder: Path, *arguments: str) -> Iterator[str]:
    """Start the server of a notebook, as a module of this Python, and yield its address."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    homes = ("HOME", "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR", "IPYTHONDIR", "XDG_CONFIG_HOME")
    environment = {**os.environ, **{name: str(folder / "home") for name in homes}}
    (folder / "home").mkdir()
    with (folder / "said.txt").open("w") as said:
        process = subprocess.Popen(
            [sys.executable, "-m", *(text.format(port=port) for text in arguments)],
            cwd=folder, env=environment, stdout=said, stderr=subprocess.STDOUT,
        )  # fmt: skip
        try:
            address, end = f"http://127.0.0.1:{port}/", time.monotonic() + STARTED
            while not _answers(address):
                assert process.poll() is None, (folder / "said.txt").read_text()
                assert time.monotonic() < end, (folder / "said.txt").read_text()
                time.sleep(0.1)
            yield address
        finally:
            process.terminate()
            process.wait(20)


def _answers(address: str) -> bool:
    try:
        with urllib.request.urlopen(address, timeout=2):
            return True
    except urllib.error.HTTPError:  # it asks for the token
        return True
    except OSError:
        return False


def run_the_first_cell(tab: Any) -> None:
    """Run it; a busy JupyterLab may lose the keys while it attaches the kernel, and then they are pressed again."""
    prompt = tab.locator(".jp-Notebook .jp-Cell .jp-InputPrompt").first
    for _ in range(10):
        tab.locator(".jp-Notebook .jp-Cell .cm-content").first.click()
        tab.keyboard.press("Shift+Enter")
        for _ in range(50):
            if prompt.inner_text().strip() != "[ ]:":
                return
            time.sleep(0.1)
    raise AssertionError(f"the cell did not run within 50 s; the page shows:\n{tab.locator('body').inner_text()}")


def the_keys_move_the_point_to_the_numbers_of_evaluate(tab: Any, folder: Path) -> None:
    """Press the keys on the point of the widget, and compare with the command that it shows."""
    try:
        tab.wait_for_selector(".explore[data-refined=true]")
    except Exception as error:  # of playwright, which is imported by the tests of a browser only
        told = "\n".join([tab.locator("body").inner_text(), *tab.locator(".explore").all_inner_texts()])
        raise AssertionError(f"no refined point; the page shows:\n{told}") from error
    handle = tab.locator(".handle")
    handle.focus()
    theta = 0.052
    for _ in range(6):
        handle.press("ArrowLeft")
        theta = float(f"{theta * 1.08:.3g}")
    tab.wait_for_selector(f".explore[data-refined=true][data-setting='problem=two-mass&policy.theta={theta:g}']")
    cost, _, traffic = (cell.strip() for cell in tab.locator(".numbers tr.policy > td").all_text_contents())
    tab.get_by_role("button", name="Take away").click()
    command = tab.locator(".takeaway pre").first.inner_text()
    assert f"theta={theta:g}" in command
    found = evaluated(folder, command)
    (rate,) = found["rates"].values()
    assert (cost, traffic) == (written(found["cost"]), written(rate))


def opened(browser: Any, address: str) -> tuple[Any, list[str]]:
    """Return a page, and the errors of its scripts."""
    tab, errors = browser.new_page(viewport={"width": 1500, "height": 1000}), list[str]()
    tab.set_default_timeout(PATIENCE)
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.goto(address)
    return tab, errors


def test_the_widget_in_jupyterlab(browser: Any, tmp_path: Path) -> None:
    """A notebook is opened and its cell is run; the point of the widget moves by keys."""
    if find_spec("jupyterlab") is None:
        pytest.skip("NOT SHOWN: the widget in JupyterLab, which is not installed: pip install 'taciturn[notebooks]'")
    cell = {"cell_type": "code", "source": CELL, "metadata": {}, "outputs": [], "execution_count": None, "id": "one"}
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    notebook = {"cells": [cell], "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}
    (tmp_path / "loop.ipynb").write_text(json.dumps(notebook))
    options = ("--no-browser", "--ip=127.0.0.1", "--port={port}", "--ServerApp.port_retries=0", "--allow-root")
    with served(tmp_path, "jupyterlab", *options, f"--IdentityProvider.token={TOKEN}") as address:
        tab, errors = opened(browser, f"{address}lab/tree/loop.ipynb?token={TOKEN}")
        tab.wait_for_selector(".jp-NotebookPanel-toolbar .jp-Notebook-ExecutionIndicator[data-status=idle]")
        run_the_first_cell(tab)
        the_keys_move_the_point_to_the_numbers_of_evaluate(tab, tmp_path)
        tab.close()
    assert errors == []


def test_the_widget_in_marimo(browser: Any, tmp_path: Path) -> None:
    """An application with one cell is run; the point of the widget moves by keys."""
    if find_spec("marimo") is None:
        pytest.skip("NOT SHOWN: the widget in marimo, which is not installed: pip install 'taciturn[notebooks]'")
    (tmp_path / "loop.py").write_text(MARIMO)
    options = ("--headless", "--token-password", TOKEN, "--host", "127.0.0.1", "--port", "{port}")
    with served(tmp_path, "marimo", "run", "loop.py", *options) as address:
        tab, errors = opened(browser, f"{address}?access_token={TOKEN}")
        the_keys_move_the_point_to_the_numbers_of_evaluate(tab, tmp_path)
        tab.close()
    assert errors == []
