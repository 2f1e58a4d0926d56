"""Every run draws the same examples, leaves the user's cache alone, and names what was slow or could not be shown."""

from __future__ import annotations

import os
import time
from collections.abc import Generator, Iterator
from datetime import date
from typing import Any

import pytest
from counts import RUN
from hypothesis import settings
from selection import changed_files, in_turn, order

os.environ.setdefault("MPLBACKEND", "Agg")  # also for the examples, which run as processes
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads on matrices of six rows cost a third of the whole time
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # processes that tests start would compile the package anew, each
settings.register_profile("repeatable", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("repeatable")
NOT_SHOWN = "NOT SHOWN"  # begins the reason of a skipped test whose absence nobody may overlook
SLOW = 5.0  # seconds of processor time that no quick test should need
PROCESSOR = "processor seconds"
BEGAN = pytest.StashKey[float]()
LATE = "would have started after the time limit of this run"
START = time.monotonic()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let a run of the full counts be shortened, repeat that of a day, and end in time on a slow machine."""
    parser.addoption("--shortened", action="store_true", help="reduced counts of the evidence, and turns by the day")
    parser.addoption("--day", help="the day of turns and dated examples: YYYY-MM-DD; default: today")
    parser.addoption("--start-within", type=float, metavar="SECONDS", help="skip evidence that would start later")


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    """Tell the tests what the options ask for; workers get the day of the process that starts them."""
    config.option.day = str(config.getoption("--day") or date.today())
    try:
        RUN.day = date.fromisoformat(config.option.day)
    except ValueError:
        raise pytest.UsageError(f"--day is {config.option.day!r}; expected YYYY-MM-DD") from None
    RUN.shortened = config.getoption("--shortened")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Choose and order the full counts of a shortened run."""
    if RUN.shortened:
        daily = {item.nodeid for item in items if item.get_closest_marker("daily")}
        chosen = order([(item.nodeid, item.path) for item in items], RUN.day, changed_files(), daily)
        left = set(range(len(items))) - set(chosen)
        config.hook.pytest_deselected(items=[items[position] for position in sorted(left)])
        items[:] = [items[position] for position in chosen]


def processor_seconds() -> float:
    """Return the processor time of this process and of its children that have ended."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Start the count of a test's processor time."""
    item.stash[BEGAN] = processor_seconds()
    limit = item.config.getoption("--start-within")
    if limit is not None and item.get_closest_marker("evidence") and time.monotonic() - START > limit:
        turn = "whose turn it is" if in_turn(item.nodeid, RUN.day) else "that the change reaches"
        pytest.skip(f"{NOT_SHOWN}: full counts {turn}: each {LATE}")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Write the processor time of a test into its last report, which also reaches the process that starts workers."""
    report = yield
    if call.when == "teardown":
        report.user_properties.append((PROCESSOR, processor_seconds() - item.stash[BEGAN]))
    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """List slow quick tests, then, in red, what this machine cannot show."""
    if RUN.shortened:
        terminalreporter.write_line(f"shortened: --day {RUN.day} repeats turns and dated examples")
    reports = [report for group in terminalreporter.stats.values() for report in group]
    quick = [report for report in reports if is_last(report) and "evidence" not in report.keywords]
    used = {report.nodeid: dict(report.user_properties).get(PROCESSOR, 0.0) for report in quick}
    for name, seconds in sorted(used.items(), key=lambda entry: -entry[1]):
        if seconds > SLOW:
            terminalreporter.write_line(f"{seconds:5.1f} s of processor time, more than {SLOW:g} s: {name}")
    skipped = [report.longrepr for report in terminalreporter.stats.get("skipped", [])]
    reasons = {entry[2].removeprefix("Skipped: ") for entry in skipped if isinstance(entry, tuple)}
    for reason in sorted({reason.removeprefix(f"{NOT_SHOWN}: ") for reason in reasons}):
        terminalreporter.write_line(f"{NOT_SHOWN}: {reason}", red=True, bold=True)
    for turn in ("whose turn it is", "that the change reaches"):
        late = [one for one in terminalreporter.stats.get("skipped", []) if f"{turn}: each {LATE}" in str(one.longrepr)]
        if late:
            terminalreporter.write_line(f"{NOT_SHOWN}: {len(late)} full counts {turn}; -m evidence runs them", red=True)


def is_last(report: object) -> bool:
    """Tell whether a report is the one after a test's teardown."""
    return isinstance(report, pytest.TestReport) and report.when == "teardown"


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep compiled programs out of the user's cache, in one that the workers of a run share."""
    own = tmp_path_factory.getbasetemp()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str((own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "cache"))
        yield


@pytest.fixture(scope="session")
def kernel() -> None:
    """Skip, so that nobody overlooks it, where namespaces cannot be made."""
    import taciturn  # not earlier than the threads of OpenBLAS are told above
    from taciturn.errors import ProblemError
    from taciturn_udp.namespaces import KernelLoss, Namespaces

    try:
        with Namespaces(taciturn.load("lossy-double-integrator").design(), {"sensor": KernelLoss(1, 1)}):
            pass
    except ProblemError as error:
        pytest.skip(f"{NOT_SHOWN}: kernel loss; {error}")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Return a browser; skip, so that nobody overlooks it, where there is none."""
    from twin.browser import browse, missing  # most tests look at no page

    if lacks := missing():
        pytest.skip(f"{NOT_SHOWN}: a page in a browser; {lacks}")
    with browse() as found:
        yield found


@pytest.fixture(autouse=True)
def one_thread_each(request: pytest.FixtureRequest) -> Iterator[None]:
    """Run the full counts on one thread where workers run side by side: two on every processor took a third longer."""
    if "PYTEST_XDIST_WORKER" not in os.environ or request.node.get_closest_marker("evidence") is None:
        yield
        return
    from taciturn.program.machine import one_thread  # after the environment above is set

    with one_thread():
        yield
