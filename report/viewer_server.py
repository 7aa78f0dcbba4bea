"""A server of viser that answers only who knows the token of the page.

viser itself lets every user of the machine in. It serves its page and its WebSocket by one server of the library
websockets, which asks a function about each request first. Here that function checks the token.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any

from report.access import REFUSAL, Access


def start_viewer_server(label: str, port: int, access: Access) -> Any:
    """Start a server of viser on the loopback interface, in the background.

    Args:
        label: title of the viewer's panel.
        port: port to listen on; if it is in use, the next free one is taken.
        access: the token that requests must bring.

    Raises:
        ValueError: viser is not installed, or this version of it cannot be protected.
    """
    try:
        import viser
    except ImportError:
        raise ValueError("the viewer needs viser: `make scene=X view`, or `pip install viser`") from None
    with _protect_servers(access) as protected:
        server = viser.ViserServer(host="127.0.0.1", port=port, label=label, verbose=False)
    if not protected:
        server.stop()
        raise ValueError(f"viser {viser.__version__} does not ask for the token of the page; install another version")
    return server


@contextmanager
def _protect_servers(access: Access) -> Iterator[list[bool]]:
    """Let each websockets server that starts in this context check the token; yields a list with an entry for each."""
    from websockets.asyncio import server

    original, protected = server.serve, []

    def serve(*arguments: Any, process_request: Callable[[Any, Any], Any] | None = None, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            has_token = access.has_token(request.path.partition("?")[2])
            if not (has_token or access.has_cookie(request.headers.get_all("Cookie"))):
                return connection.respond(HTTPStatus.FORBIDDEN, REFUSAL + "\n")
            answer = process_request(connection, request) if process_request else None
            if answer is not None and has_token:
                answer.headers["Set-Cookie"] = access.make_cookie()
            return answer

        protected.append(True)
        return original(*arguments, process_request=check, **options)

    server.serve = serve  # type: ignore[assignment, misc]
    try:
        yield protected
    finally:
        server.serve = original  # type: ignore[misc]
