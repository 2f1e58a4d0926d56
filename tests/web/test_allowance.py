"""The computing time of the clients of a page."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from starlette.exceptions import HTTPException

from taciturn_web import allowance
from taciturn_web.allowance import Allowance


def test_a_client_that_has_used_its_time_waits_until_it_returns(monkeypatch: pytest.MonkeyPatch) -> None:
    """The others do not; and so many clients cannot fill the memory."""
    now = [100.0]
    monkeypatch.setattr(allowance, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(allowance, "MOST", 3)
    given = Allowance(2.0, 0.5)
    given.use("a", 1.5)
    given.check("a")
    given.use("a", 1.5)
    given.check("b")
    with pytest.raises(HTTPException) as refused:
        given.check("a")
    assert (refused.value.status_code, dict(refused.value.headers or {})) == (429, {"Retry-After": "3"})
    now[0] += 2.1
    given.check("a")
    for client in "bcde":
        given.use(client, 1.0)
    assert list(given._used) == ["c", "d", "e"]
