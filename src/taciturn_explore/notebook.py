"""The page in a notebook cell of JupyterLab, VS Code or marimo, shown by the package anywidget.

The widget is built once. Its trait ``setting`` is the text of the setting that it shows: it follows the page, and a new
value moves the page. Requests and answers are messages; answers are computed by the workers of the page (``work``),
which all widgets of a process share.
"""

from __future__ import annotations

import asyncio
import secrets
import threading
from collections.abc import Callable, Coroutine, Mapping
from contextlib import aclosing
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

from taciturn.errors import ProblemError, TaciturnError
from taciturn.problem import Problem
from taciturn_explore.bundle import bundle, styles, variable
from taciturn_explore.files import problem_file
from taciturn_explore.session import Sessions
from taciturn_explore.setting import Setting, Trusted, setting_for, setting_of
from taciturn_explore.work import AT_ONCE, Pool


def explore(problem: str | Path | Problem = "two-mass") -> Any:
    """Return a notebook widget that shows the cost and the traffic of a problem while a user changes its settings.

    The widget is the page of ``taciturn explore`` in a cell of JupyterLab, VS Code or marimo. Drag the point along its
    curve; the attribute ``problem`` is the problem with the shown settings.

    Args:
        problem: a problem file, the name of a built-in problem, or a problem that was read from one.

    Returns:
        The widget. Its trait ``setting`` is the text of the shown setting: it follows the page, and a new value moves
        the page. Its attribute ``problem`` is the problem of the shown setting.

    Raises:
        ProblemError: the problem was not read from a file, or anywidget is not installed.

    Example:
        >>> widget = explore("two-mass")
        >>> widget.setting = "problem=two-mass&policy.theta=0.1"
        >>> widget.problem.parameters["theta"]
        0.1
    """
    if find_spec("anywidget") is None:
        raise ProblemError("anywidget is not installed, but the widget requires it: pip install 'taciturn[explore]'")
    if isinstance(problem, Problem):
        if problem.source is None:
            raise ProblemError(
                "the problem was not read from a file, so its keys cannot be changed; expected a problem file, such "
                "as one that taciturn new writes, or the name of a built-in problem"
            )
        text = problem_file(Setting(name=problem.kind), problem)
        begin, trusted = Setting(file=text), Trusted(text, ".", problem.name)
    else:
        begin, trusted = setting_for(str(problem))
    return _widget_class()(begin, trusted)


@cache
def _widget_class() -> Any:
    """Return the class of the widget, for which anywidget is imported."""
    import anywidget
    import traitlets

    class Explorer(anywidget.AnyWidget):
        """Notebook widget that shows the page in a cell."""

        _esm = bundle("widget") + f"export default {{ render: {variable('widget')}.render }};\n"
        setting = traitlets.Unicode().tag(sync=True)
        styles = traitlets.Unicode(styles(":host")).tag(sync=True)

        def __init__(self, begin: Setting, trusted: Trusted | None) -> None:
            """Show a setting."""
            super().__init__(setting=begin.text)
            self._trusted, self._sessions = trusted, Sessions(_pool(trusted))
            self._name = secrets.token_hex(8)
            self._tell: Callable[[dict[str, Any]], None] = cast("Any", self).send
            self._running: dict[str, asyncio.Task[None]] = {}
            cast("Any", self).on_msg(self._hear)

        @property
        def problem(self) -> Problem:
            """The problem as changed by the settings that the page shows at present."""
            setting = setting_of(self.setting.partition("&pin=")[0])
            return setting.problem(setting.base(self._trusted))

        def _hear(self, _: object, content: Mapping[str, Any], __: object) -> None:
            """Begin or end the answers to a message."""
            try:
                asyncio.get_running_loop()  # that of the notebook, on whose thread messages may be sent
            except RuntimeError:
                _loop().call_soon_threadsafe(self._begin, content)
            else:
                self._begin(content)

        def _begin(self, content: Mapping[str, Any]) -> None:
            name = str(content.get("id", ""))
            former = self._running.pop(name, None)
            if former is not None:
                former.cancel()
            if not content.get("end"):
                work: Coroutine[Any, Any, None] = self._answer(name, content)
                self._running[name] = asyncio.get_running_loop().create_task(work)

        async def _answer(self, name: str, content: Mapping[str, Any]) -> None:
            """Send the answers to a message, and its end."""
            try:
                if "file" in content:
                    job = self._sessions.pool.submit(self._name, "file", str(content["file"]), rank=AT_ONCE)
                    self._tell({"id": name, "result": await asyncio.wrap_future(job)})
                    return
                request = {
                    **content.get("request", {}),
                    "client": f"{self._name}{content['request'].get('whose', '')}",
                }
                async with aclosing(self._sessions.answers(request)) as found:
                    async for answer in found:
                        self._tell({"id": name, "answer": answer})
                self._tell({"id": name})
            except TaciturnError as error:
                self._tell({"id": name, "error": str(error)})
            finally:
                self._running.pop(name, None)

    return Explorer


@cache
def _pool(trusted: Trusted | None) -> Pool:
    """Return the workers for problems with the same file."""
    return Pool(trusted)


@cache
def _loop() -> asyncio.AbstractEventLoop:
    """Return an event loop on a thread of its own, for messages that come from no loop."""
    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, name="explore", daemon=True).start()
    return loop
