"""Every run draws the same examples, so that a failure can be repeated, and leaves the user's cache alone."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
from hypothesis import settings

os.environ.setdefault("MPLBACKEND", "Agg")  # also for the examples, which run as processes
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads on matrices of six rows cost a third of the whole time
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # processes that tests start would compile the package anew, each
settings.register_profile("repeatable", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("repeatable")
NOT_SHOWN = "NOT SHOWN"  # begins the reason of a skipped test whose absence nobody may overlook


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say at the end, in red, what this machine cannot show."""
    skipped = [report.longrepr for report in terminalreporter.stats.get("skipped", [])]
    reasons = {entry[2].removeprefix("Skipped: ") for entry in skipped if isinstance(entry, tuple)}
    for reason in sorted(reason for reason in reasons if reason.startswith(NOT_SHOWN)):
        terminalreporter.write_line(reason, red=True, bold=True)


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
    from taciturn.runtime.namespaces import KernelLoss, Namespaces

    try:
        with Namespaces(taciturn.load("lossy-double-integrator").design(), {"sensor": KernelLoss(1, 1)}):
            pass
    except ProblemError as error:
        pytest.skip(f"{NOT_SHOWN}: kernel loss; {error}")


@pytest.fixture(autouse=True)
def one_thread_each(request: pytest.FixtureRequest) -> Iterator[None]:
    """Run the full counts on one thread where workers run side by side: two on every processor took a third longer."""
    if "PYTEST_XDIST_WORKER" not in os.environ or request.node.get_closest_marker("evidence") is None:
        yield
        return
    from taciturn.program.machine import one_thread  # after the environment above is set

    with one_thread():
        yield
