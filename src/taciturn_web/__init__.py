"""Pages for a web browser: their server, access control, events, and common files.

``guard.guarded`` builds an application that checks every request, ``serving.Served`` serves it on a thread, with limits
on its ``connections``. ``events`` has a log of server-sent events, and ``allowance`` limits the computing time of a
client. ``assets/`` has uPlot, the colours, curves, and the requests of pages. A page is a module like
``taciturn_twins.page``: routes, and a folder with ``index.html`` and its scripts.
"""

from __future__ import annotations

from importlib.util import find_spec

from taciturn.errors import ProblemError

if missing := [name for name in ("starlette", "uvicorn") if find_spec(name) is None]:
    raise ProblemError(
        f"the package {missing[0]} is not installed, but pages in a browser require it: pip install 'taciturn[explore]'"
    )
