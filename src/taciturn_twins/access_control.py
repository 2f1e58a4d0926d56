"""Access control of a live page: users with the token are admitted or, without a token, users on this machine only.

Any web page open in a browser on this machine can send requests to the loopback. However, a page cannot forge the
headers Host and Origin, and cannot send JSON to another origin without permission of that server. These two rules block
requests of other pages if there is no token.
"""

from __future__ import annotations

import hmac
from email.message import Message
from urllib.parse import parse_qs, quote

from taciturn.errors import ProblemError
from taciturn.nodes.keys import is_loopback
from taciturn_udp.endpoint import Address


class AccessControl:
    """The access control of a server, which checks every request.

    Args:
        bind: address that the server listens on.
        token: token that every request must contain, in printable ASCII without spaces; None: requests must come from
            the loopback.

    Raises:
        ProblemError: other machines can reach the server and no token is given, or the token is not valid in a header.

    Example:
        >>> AccessControl(("127.0.0.1", 8000), "s3cret").query
        '?token=s3cret'
    """

    def __init__(self, bind: Address, token: str | None = None) -> None:
        """Reject an address that would be open to all machines."""
        if token is None and not is_loopback(bind[0]):
            raise ProblemError(
                f"the page would listen on {bind[0] or 'every address'} without a token; expected a loopback address, "
                "e.g. 127.0.0.1, or a token, because otherwise anyone could disturb the run"
            )
        if token is not None and not (token and token.isascii() and token.isprintable() and " " not in token):
            raise ProblemError(f"token is {token!r}; expected printable ASCII characters without spaces")
        self._token = token

    @property
    def query(self) -> str:
        """Query string at the end of the page's address."""
        return "" if self._token is None else f"?token={quote(self._token, safe='')}"

    def admits(self, headers: Message, query: str) -> bool:
        """Return whether a request may read: its URL contains the token, or its Host is this machine."""
        if self._token is None:
            return is_loopback(_host_of(headers))
        return self._fits(parse_qs(query).get("token", []))

    def obeys(self, headers: Message) -> bool:
        """Return whether a request may act: ``Authorization: Bearer TOKEN``, or Host and Origin are this machine."""
        if headers.get_content_type() != "application/json":
            return False
        if self._token is not None:
            given: list[str] = headers.get_all("Authorization", [])
            return self._fits([text.removeprefix("Bearer ") for text in given])
        origins: list[str] = headers.get_all("Origin", [])
        own = f"http://{headers.get('Host', '')}"
        return is_loopback(_host_of(headers)) and all(origin == own for origin in origins)

    def _fits(self, given: list[str]) -> bool:
        token = self._token or ""
        return len(given) == 1 and hmac.compare_digest(given[0].encode("utf-8", "replace"), token.encode())


def _host_of(headers: Message) -> str:
    """Return the name in the header Host without the port, or an empty text if there is not exactly one Host."""
    hosts: list[str] = headers.get_all("Host", [])
    if len(hosts) != 1:
        return ""
    name, colon, port = hosts[0].rpartition(":")
    host = name if colon and port.isdecimal() else hosts[0]
    return host[1:-1] if host.startswith("[") and host.endswith("]") else host
