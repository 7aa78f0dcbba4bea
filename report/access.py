"""The token in the address of a page. On a machine that several people use, each of them can reach its loopback ports.

The page's address holds the token once; a cookie keeps it afterwards. The page and its 3D viewer share both, since
browsers send the cookies of a host to all its ports.
"""

from __future__ import annotations

import secrets
from collections.abc import Iterable
from dataclasses import dataclass, field
from urllib.parse import parse_qs

REFUSAL = "refused: open the address that the program printed, which ends with a token"
COOKIE_SECONDS = 7 * 24 * 3600  # a browser that was closed may come back; the token itself ends with the program


def _make_token() -> str:
    """Return a token that nobody guesses: 256 random bits as text for an address."""
    return secrets.token_urlsafe(32)


@dataclass(frozen=True)
class Access:
    """The token of a page, and the checks of requests for it.

    Attributes:
        port: port of the page. It is part of the cookie's name, so that the pages of two ports do not overwrite each
            other's cookies.
        token: the token.
    """

    port: int
    token: str = field(default_factory=_make_token, repr=False)

    @property
    def cookie(self) -> str:
        """The name of the cookie that holds the token."""
        return f"reffusion_{self.port}"

    def link(self, address: str, fragment: str = "") -> str:
        """Return an address of the page with the token, and with a fragment (after "#") if one is given."""
        return f"{address}?token={self.token}" + (f"#{fragment}" if fragment else "")

    def has_token(self, query: str) -> bool:
        """Return whether the query of an address, the part after "?", holds the token."""
        return any(self._is_token(given) for given in parse_qs(query).get("token", ()))

    def has_cookie(self, headers: Iterable[str]) -> bool:
        """Return whether the token is in one of the `Cookie` headers of a request."""
        pairs = [pair.strip().partition("=") for header in headers for pair in header.split(";")]
        return any(self._is_token(value) for name, _, value in pairs if name == self.cookie)

    def make_cookie(self) -> str:
        """Return the `Set-Cookie` header that keeps the token, hidden from scripts and not sent for other sites."""
        return f"{self.cookie}={self.token}; Path=/; Max-Age={COOKIE_SECONDS}; HttpOnly; SameSite=Strict"

    def _is_token(self, given: str) -> bool:
        """Return whether a text is the token, in a time that does not depend on where the two differ."""
        return secrets.compare_digest(given.encode(), self.token.encode())
