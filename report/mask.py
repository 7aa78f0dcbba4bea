"""Masks from clicks, in a browser: `python -m report.mask --scene demo` (`make scene=X mask`).

Places the photographs (the stage `poses`), serves the page, and fits the scene meanwhile, for masks of all views.
Served on this machine only.
"""

from __future__ import annotations

import json
import subprocess
import sys
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from urllib.parse import unquote, urlsplit

import numpy as np
from PIL import Image

from report import cli
from report.mask_session import Session, load_capture, load_local_segmenter

PORT = 8090
PAGE = Path(__file__).with_name("mask.html")
THUMBNAIL = 160  # px, larger side
MAX_REQUEST_BYTES = 2_000_000  # bytes of a request
TINT = (255, 0, 160)
# The page is one file, and asks nobody but this server.
POLICY = "default-src 'none'; img-src 'self' data:; connect-src 'self'; "
POLICY += "style-src 'unsafe-inline'; script-src 'unsafe-inline'"


class Server(ThreadingHTTPServer):
    """The session's server, on the loopback; on the next free port where `port` is taken."""

    daemon_threads = True

    def __init__(self, session: Session, port: int = PORT, fit: subprocess.Popen | None = None):
        self.session, self.fit = session, fit
        for number in range(port, port + 100):
            try:
                super().__init__(("127.0.0.1", number), Handler)
                return
            except OSError:
                continue
        raise ValueError(f"no free port from {port} to {port + 99}; give another as port=")

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/"

    def state(self) -> dict:
        """The session's, and how it stands with the fit."""
        running = self.fit is not None and self.fit.poll() is None
        return self.session.state() | {"fitting": running}


class Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        kind, _, rest = unquote(urlsplit(self.path).path).lstrip("/").partition("/")
        session = self.server.session
        if not self._from_here():
            self._say(HTTPStatus.FORBIDDEN, {"error": "this page is for this machine only"})
        elif kind == "":
            self._answer(HTTPStatus.OK, "text/html; charset=utf-8", PAGE.read_bytes())
        elif kind == "state":
            self._say(HTTPStatus.OK, self.server.state())
        elif kind in ("photo", "small") and rest in session.images:
            self._answer(HTTPStatus.OK, "image/jpeg", _jpeg(session.images[rest], kind == "small"))
        elif kind == "mask" and rest in session.masks:
            self._answer(HTTPStatus.OK, "image/png", _tinted(session.masks[rest]))
        else:
            self._say(HTTPStatus.NOT_FOUND, {"error": "no such page"})

    def do_POST(self) -> None:
        length = int(self.headers.get("Content-Length") or 0)
        if not self._from_here() or length > MAX_REQUEST_BYTES:
            self._say(HTTPStatus.FORBIDDEN, {"error": "this page is for this machine only"})
            return
        try:
            said = json.loads(self.rfile.read(length) or b"{}")
            if self.path == "/clicks":
                points = [(float(x), float(y), sign == "+") for x, y, sign in said["clicks"]]
                self.server.session.click(str(said["view"]), points)
                self._say(HTTPStatus.OK, self.server.state())
            elif self.path == "/save":
                self._say(HTTPStatus.OK, self.server.session.save())
            else:
                self._say(HTTPStatus.NOT_FOUND, {"error": "no such page"})
        except (ValueError, KeyError, TypeError, OSError) as error:
            self._say(HTTPStatus.BAD_REQUEST, {"error": str(error)})

    def _from_here(self) -> bool:
        """Other pages in the same browser may send requests here too, under their own name or another host's."""
        own = f"127.0.0.1:{self.server.server_address[1]}"
        local = (own, own.replace("127.0.0.1", "localhost"))
        origin = self.headers.get("Origin")
        return self.headers.get("Host") in local and (origin is None or urlsplit(origin).netloc in local)

    def _say(self, status: HTTPStatus, said: dict) -> None:
        self._answer(status, "application/json", json.dumps(said).encode())

    def _answer(self, status: HTTPStatus, kind: str, content: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", POLICY)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: object) -> None:
        """Nothing: the terminal shows how the fit goes on."""


def _jpeg(image: np.ndarray, small: bool) -> bytes:
    picture, file = Image.fromarray(image), BytesIO()
    if small:
        picture.thumbnail((THUMBNAIL, THUMBNAIL))
    picture.save(file, "JPEG", quality=80 if small else 92)
    return file.getvalue()


def _tinted(mask: np.ndarray) -> bytes:
    """PNG, the mask in colour, its rim opaque, clear elsewhere."""
    inner = mask.copy()
    inner[1:-1, 1:-1] = mask[1:-1, 1:-1] & mask[:-2, 1:-1] & mask[2:, 1:-1] & mask[1:-1, :-2] & mask[1:-1, 2:]
    drawn = np.zeros((*mask.shape, 4), np.uint8)
    drawn[mask] = (*TINT, 110)
    drawn[mask & ~inner] = (*TINT, 255)
    file = BytesIO()
    Image.fromarray(drawn).save(file, "PNG", compress_level=1)
    return file.getvalue()


def stage_command(stage: str, arguments) -> list[str]:
    """The command that runs a stage of a scene that may have no masks yet."""
    given = {"--profile": arguments.profile, "--budget": arguments.budget}
    said = [word for name, value in given.items() if value for word in (name, value)]
    words = ["run", stage, "--scene", str(arguments.scene), "--runs", str(arguments.runs), *said]
    return [sys.executable, "-m", "reffusion.command", *words, "--set", f"{arguments.set} poses.clicks={{}}"]


def main() -> None:
    parser = cli.scene_parser("mask", __doc__)
    parser.add_argument("--port", type=int, default=PORT, help="the next free one is taken where it is not free")
    parser.add_argument("--profile", help="as of `stage_command`; these four are for the stages `poses` and `fit`")
    parser.add_argument("--budget", help="as of `stage_command`")
    parser.add_argument("--set", default="", help="as of `stage_command`")
    arguments = parser.parse_args()
    if status := subprocess.run(stage_command("poses", arguments)).returncode:
        raise SystemExit(status)
    try:
        capture, segmenter = load_capture(cli.run_folder(arguments)), load_local_segmenter()
        fit = subprocess.Popen(stage_command("fit", arguments))
        session = Session(capture, lambda: fit.poll() == 0, segmenter)
        server = Server(session, arguments.port, fit)
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None
    print(f"{server.address}  (Ctrl-C ends)", flush=True)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        fit.terminate()
        fit.wait()


if __name__ == "__main__":
    main()
