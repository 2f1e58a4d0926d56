"""Processes end on a signal in one way: promptly, with one line, and with the exit code of the signal."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest
from terminals import in_a_terminal

START = """
import os, signal, sys, time
from taciturn._process import at_once, deferred, ends_on_signals, remark, until_stopped
def me(number=signal.SIGINT):
    os.kill(os.getpid(), number)
"""
POSIX = pytest.mark.skipif(sys.platform == "win32", reason="signals are sent by os.kill")
pytestmark = POSIX


def ends(body: str, grace: str = "0.1") -> tuple[int, str, str]:
    """Return exit code, standard error and standard output of a program that signals itself; the output shows order."""
    program = START + "".join(f"{line}\n" for line in body.strip("\n").splitlines())
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        timeout=20,
        check=False,
        preexec_fn=in_a_terminal,
        env={"TACITURN_GRACE": grace, "PYTHONPATH": str(Path(__file__).parent.parent / "src")},
    )
    return done.returncode, done.stderr, done.stdout


@pytest.mark.parametrize(
    ("name", "code", "line"),
    [("SIGINT", 130, "interrupted"), ("SIGTERM", 143, "ended by SIGTERM"), ("SIGHUP", 129, "ended by SIGHUP")],
)
def test_a_signal_ends_a_process_with_its_code_and_one_line(name: str, code: int, line: str) -> None:
    """Cleanup runs, and the line names what is kept."""
    body = f"""
with ends_on_signals(), remark("the results are in x"):
    try:
        me(signal.{name})
        time.sleep(60)
    finally:
        print("cleaned")
"""
    assert ends(body, grace="10") == (code, f"taciturn: {line}; the results are in x\n", "cleaned\n")


@pytest.mark.parametrize(
    "busy",
    [
        "import hashlib; hashlib.pbkdf2_hmac('sha256', b'', b'', 10**9)",
        "while True:\n        try:\n            time.sleep(60)\n        except KeyboardInterrupt:\n            pass",
    ],
    ids=["compiled code", "swallowed"],
)
def test_a_process_that_does_not_react_is_ended_after_the_grace_period(busy: str) -> None:
    """Compiled code runs for minutes, or a library catches the interrupt: output so far and the line are printed."""
    body = f"""
import threading
with ends_on_signals(), at_once(lambda: os.write(1, b"last call\\n")):
    print("first result")
    threading.Timer(0.05, me).start()
    {busy}
"""
    assert ends(body) == (130, "taciturn: interrupted\n", "last call\nfirst result\n")


def test_a_second_signal_ends_a_process_at_once() -> None:
    """A cleanup that takes a minute is not waited for; child processes are ended by the last calls."""
    body = """
with ends_on_signals(), at_once(lambda: os.write(1, b"last call\\n")):
    try:
        me()
        time.sleep(60)
    finally:
        me()
        time.sleep(60)
"""
    began = time.monotonic()
    assert ends(body, grace="60") == (130, "taciturn: interrupted\n", "last call\n")
    assert time.monotonic() - began < 15


def test_a_server_reports_before_it_ends() -> None:
    """It stops by itself; the exit code is that of the signal."""
    body = """
with ends_on_signals():
    with until_stopped() as stopped:
        assert not stopped()
        me(signal.SIGTERM)
        while not stopped():
            time.sleep(0.01)
    print("report")
"""
    assert ends(body, grace="10") == (143, "taciturn: ended by SIGTERM\n", "report\n")


def test_a_signal_waits_for_the_end_of_a_block_that_must_be_complete() -> None:
    """A process that starts in this block must be known before the interrupt."""
    body = """
with ends_on_signals():
    try:
        with deferred():
            me()
            print("complete")
    finally:
        print("afterwards")
"""
    assert ends(body, grace="10") == (130, "taciturn: interrupted\n", "complete\nafterwards\n")


def test_a_signal_that_was_ignored_before_stays_ignored() -> None:
    """As SIGHUP under nohup."""
    body = """
signal.signal(signal.SIGHUP, signal.SIG_IGN)
with ends_on_signals():
    me(signal.SIGHUP)
    time.sleep(0.01)
print("goes on")
"""
    assert ends(body) == (0, "", "goes on\n")


def test_a_server_in_the_background_of_a_script_stops_on_ctrl_c() -> None:
    """Shells ignore SIGINT there; SIGHUP stays ignored under nohup."""
    body = """
signal.signal(signal.SIGINT, signal.SIG_IGN)
signal.signal(signal.SIGHUP, signal.SIG_IGN)
with ends_on_signals(), until_stopped() as stopped:
    me(signal.SIGHUP)
    time.sleep(0.01)
    assert not stopped()
    me()
    while not stopped():
        time.sleep(0.01)
"""
    assert ends(body, grace="10") == (130, "taciturn: interrupted\n", "")


def test_without_a_signal_everything_is_as_before() -> None:
    """Handlers are restored, errors pass, and an inner block uses the outer one."""
    body = """
before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
try:
    with ends_on_signals() as outer, ends_on_signals() as inner:
        assert outer is inner
        raise ValueError("as it is")
except ValueError as error:
    print(error)
assert before == [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
assert signal.set_wakeup_fd(-1) == -1
"""
    assert ends(body) == (0, "", "as it is\n")


def test_a_process_ends_with_its_parent() -> None:
    """Its standard input ends even if the parent is killed; processes that it starts itself are independent."""
    program = (
        START
        + """
with ends_on_signals():
    print("starts", "TACITURN_LIFELINE" in os.environ, flush=True)
    time.sleep(60)
"""
    )
    environment = {"TACITURN_LIFELINE": "1", "PYTHONPATH": str(Path(__file__).parent.parent / "src")}
    with subprocess.Popen(
        [sys.executable, "-c", program],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    ) as running:
        assert running.stdin is not None
        assert running.stdout is not None
        assert running.stderr is not None
        assert running.stdout.readline() == "starts False\n"
        running.stdin.close()
        assert running.stderr.read() == "taciturn: ended by SIGTERM\n"
        assert running.wait(20) == 143
