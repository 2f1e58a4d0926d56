"""Who may see a page and who may act on its run: whoever has the token, or, where there is none, this machine alone.

Any page that is open in a browser here can send requests to the loopback. It cannot forge the headers Host and Origin,
nor send JSON to another origin unasked: that keeps it out where no token does.
"""

from __future__ import annotations

import hmac
import ipaddress
from email.message import Message
from urllib.parse import parse_qs, quote

from taciturn.errors import ProblemError
from taciturn.runtime.udp import Address


class Door:
    """The check of every request.

    Args:
        bind: where the server listens.
        token: what a request must carry, printable ASCII without spaces; None: it must come from the loopback.

    Raises:
        ProblemError: no token where others can reach the server, or one that no header can carry.

    Example:
        >>> Door(("127.0.0.1", 8000), "s3cret").query
        '?token=s3cret'
    """

    def __init__(self, bind: Address, token: str | None = None) -> None:
        """Refuse a door that would stand open."""
        if token is None and not is_loopback(bind[0]):
            raise ProblemError(
                f"the page is to listen on {bind[0] or 'every address'} without a token; expected a loopback address "
                "as 127.0.0.1, or a token, so that not everybody can disturb the run"
            )
        if token is not None and not (token and token.isascii() and token.isprintable() and " " not in token):
            raise ProblemError(f"token is {token!r}; expected one or more ASCII letters, digits and signs, no spaces")
        self._token = token

    @property
    def query(self) -> str:
        """What the address of the page ends with."""
        return "" if self._token is None else f"?token={quote(self._token, safe='')}"

    def admits(self, headers: Message, query: str) -> bool:
        """Tell whether a request may see: its token stands in the address, or its Host is this machine."""
        if self._token is None:
            return is_loopback(_host_of(headers))
        return self._fits(parse_qs(query).get("token", []))

    def obeys(self, headers: Message) -> bool:
        """Tell whether a request may act: ``Authorization: Bearer TOKEN``, or Host and Origin are this machine."""
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


def is_loopback(host: str) -> bool:
    """Tell whether a name or an address means this machine.

    Example:
        >>> [is_loopback(host) for host in ("127.0.0.1", "localhost", "::1", "localhost.evil.example", "0.0.0.0")]
        [True, True, True, False, False]
    """
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _host_of(headers: Message) -> str:
    """Return the name in the header Host without its port; empty where there is none, or more than one."""
    hosts: list[str] = headers.get_all("Host", [])
    if len(hosts) != 1:
        return ""
    name, colon, port = hosts[0].rpartition(":")
    host = name if colon and port.isdecimal() else hosts[0]
    return host[1:-1] if host.startswith("[") and host.endswith("]") else host
