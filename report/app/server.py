"""The server of the page, on the loopback interface."""

from __future__ import annotations

import logging
import signal
import socket
import threading

import uvicorn

from report.access import Access
from report.app.app import App
from report.app.routes import make_app
from report.app.tasks import free_port

PORT = 8090


class Server:
    """Web server of the page.

    Args:
        app: scenes and jobs that the page shows.
        port: port to listen on; if it is in use, the next free one of the following 99 is taken.

    Raises:
        ValueError: none of the 100 ports is free.
    """

    def __init__(self, app: App, port: int = PORT):
        self.app, self.port = app, free_port(port)
        self.access = Access(self.port)
        self.socket = socket.socket()
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(("127.0.0.1", self.port))
        self.socket.listen()  # a browser may ask before the server runs
        config = uvicorn.Config(
            make_app(app, self.access),
            log_level="error",
            access_log=False,
            timeout_graceful_shutdown=1,
            lifespan="off",
            ws="none",
        )
        self.server = uvicorn.Server(config)

    def link(self, path: str = "", fragment: str = "") -> str:
        """Return the address of a page with the token.

        Args:
            path: path of the page, without the first slash.
            fragment: what follows "#".
        """
        return self.access.link(f"http://127.0.0.1:{self.port}/{path}", fragment)

    def serve(self) -> None:
        """Serve the page until Ctrl-C, SIGTERM or `stop`. Jobs that the page started are then interrupted."""
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, signal.default_int_handler)  # SIGTERM is handled like Ctrl-C
        # At the end the requests of open tabs are cancelled, which is no error to print.
        is_told = lambda record: not self.server.should_exit
        log = logging.getLogger("uvicorn.error")
        log.addFilter(is_told)
        try:
            self.server.run(sockets=[self.socket])
        except KeyboardInterrupt:
            pass
        finally:
            log.removeFilter(is_told)
            self.app.close()

    def stop(self) -> None:
        """Let `serve` return soon. May be called from any thread."""
        self.server.should_exit = True


def announce(server: Server, address: str) -> None:
    """Print where the page is, from this machine and from others.

    Args:
        address: a result of `Server.link`.
    """
    ports = f"{server.port}:localhost:{server.port} -L {server.app.viewer.port}:localhost:{server.app.viewer.port}"
    print(f"{address}  (Ctrl-C ends)", flush=True)
    print(f"from another machine: `ssh -L {ports} THIS_MACHINE`, then open this address there", flush=True)
