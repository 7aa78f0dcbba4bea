"""Checks of every request: it comes from this server's own page, which only who knows the token can open."""

from __future__ import annotations

from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from report.access import REFUSAL, Access

MAX_JSON_BYTES = 2_000_000
ELSEWHERE = "this page is for this machine only"


class TooLarge(ValueError):
    """Exception for a request whose body is larger than allowed."""


class OwnPageOnly:
    """Middleware that refuses requests of other pages, machines and users, and binds the page to this server.

    Other pages in the same browser can send requests to this server too. Their requests have another origin or host
    name. Programs of other users of this machine can send any request, but they do not know the token.

    Args:
        app: the application.
        access: the token, and the port of this server.
        frames: ports of this machine whose pages may be embedded.
    """

    def __init__(self, app: ASGIApp, access: Access, frames: tuple[int, ...] = ()):
        self.app, self.access = app, access
        self.hosts = {f"{name}:{access.port}" for name in ("127.0.0.1", "localhost")}
        embedded = " ".join(f"http://{name}:{each}" for each in frames for name in ("127.0.0.1", "localhost"))
        self.policy = (
            "default-src 'none'; img-src 'self' data: blob:; media-src 'self'; connect-src 'self'; "
            "style-src 'self' 'unsafe-inline'; script-src 'self' 'unsafe-inline'; base-uri 'none'; "
            f"form-action 'none'; frame-ancestors 'self'; frame-src 'self' {embedded}"
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = Headers(scope=scope)
        has_token = self.access.has_token(scope["query_string"].decode("latin-1"))
        if not self._is_local(headers):
            refusal = ELSEWHERE
        else:
            refusal = "" if has_token or self.access.has_cookie(headers.getlist("cookie")) else REFUSAL
        if refusal:
            is_page = "text/html" in headers.get("accept", "")  # a person reads the answer
            answer = PlainTextResponse(refusal, 403) if is_page else JSONResponse({"error": refusal}, 403)
            await answer(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers["Content-Security-Policy"] = self.policy
                headers["X-Content-Type-Options"] = "nosniff"
                headers["Cross-Origin-Resource-Policy"] = "same-origin"
                headers["Referrer-Policy"] = "no-referrer"
                headers.setdefault("Cache-Control", "no-store")
                if has_token:
                    headers["Set-Cookie"] = self.access.make_cookie()
            await send(message)

        await self.app(scope, receive, send_with_headers)

    def _is_local(self, headers: Headers) -> bool:
        """Return whether a request names this server as its host and, if it names one, as its origin."""
        origin = headers.get("origin")
        return headers.get("host") in self.hosts and (origin is None or urlsplit(origin).netloc in self.hosts)


async def read_body(request: Request, limit: int = MAX_JSON_BYTES) -> bytes:
    """Return the body of a request.

    Raises:
        TooLarge: it has more than `limit` bytes.
    """
    content = bytearray()
    async for part in request.stream():
        content += part
        if len(content) > limit:
            raise TooLarge(f"larger than {limit // 1_000_000} MB")
    return bytes(content)
