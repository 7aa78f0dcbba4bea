"""Masks from clicks in a browser: `python -m report.mask --scene demo` (`make scene=X mask`).

The command runs the stages `poses` and `raw_masks`, then serves the page on this machine only. The stage `fit` runs in
the background, because masks of all views need the fitted Gaussians.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from urllib.parse import unquote, urlsplit

import numpy as np
from PIL import Image

from reffusion.clicks.local_segmenter import load_local_segmenter
from report import cli
from report.mask_session import Session, load_capture

PORT = 8090
PAGE = Path(__file__).with_name("mask.html")
THUMBNAIL = 160  # longer side, px
MAX_REQUEST_BYTES = 2_000_000
LOG_TAIL_BYTES = 4000
BAR = re.compile(r"(\d+)/(\d+) \[[^<\]]*<([\d:]+)")  # a progress bar's steps done, total steps, and time left
TINT = (255, 0, 160)
# The page is one file and contacts no other server.
POLICY = "default-src 'none'; img-src 'self' data:; connect-src 'self'; "
POLICY += "style-src 'unsafe-inline'; script-src 'unsafe-inline'"


class Server(ThreadingHTTPServer):
    """HTTP server of the mask page for one session, on the loopback interface.

    Args:
        session: marks and masks that the page shows and changes.
        port: port to listen on; if it is in use, the next free one of the following 99 is taken.
        fit: process of the stage `fit`; None if no fit runs.
        next_command: command that the page suggests after saving.

    Raises:
        ValueError: none of the 100 ports is free.
    """

    daemon_threads = True

    def __init__(self, session: Session, port: int = PORT, fit: subprocess.Popen | None = None, next_command: str = ""):
        self.session, self.fit, self.next_command = session, fit, next_command
        for number in range(port, port + 100):
            try:
                super().__init__(("127.0.0.1", number), Handler)
                return
            except OSError:
                continue
        raise ValueError(f"no free port from {port} to {port + 99}; choose another with port=")

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/"

    def state(self) -> dict:
        """Return the JSON state of the page: that of `Session.state`, and three more keys.

        They are "fitting": True while the process of the fit runs; "fit_progress": result of `read_progress`, or None;
        "next": command that the page suggests after saving.
        """
        running = self.fit is not None and self.fit.poll() is None
        log = self.session.capture.fit.with_suffix(".log")
        progress = read_progress(log) if running and log.is_file() else None
        return self.session.state() | {"fitting": running, "fit_progress": progress, "next": self.next_command}


def read_progress(log: Path) -> dict[str, object] | None:
    """Read the progress of a running stage from the last progress bar in the stage's log.

    Returns:
        {"share": done steps over all steps in [0, 1], "left": remaining time as the bar prints it, e.g. "01:20"}, or
        None if the log has no progress bar.
    """
    with open(log, "rb") as file:
        file.seek(max(0, log.stat().st_size - LOG_TAIL_BYTES))
        found = BAR.findall(file.read().decode("utf-8", "replace"))
    if not found or int(found[-1][1]) == 0:
        return None
    done, total, left = found[-1]
    return {"share": int(done) / int(total), "left": left}


class Handler(BaseHTTPRequestHandler):
    """Handler of the page's requests: GET sends page, state, photographs and masks; POST changes marks or saves."""

    server: Server

    def do_GET(self) -> None:
        kind, _, rest = unquote(urlsplit(self.path).path).lstrip("/").partition("/")
        session = self.server.session
        if not self._is_local_request():
            self._send_json(HTTPStatus.FORBIDDEN, {"error": "this page is for this machine only"})
        elif kind == "":
            self._send(HTTPStatus.OK, "text/html; charset=utf-8", PAGE.read_bytes())
        elif kind == "state":
            self._send_json(HTTPStatus.OK, self.server.state())
        elif kind in ("photo", "small") and rest in session.images:
            self._send(HTTPStatus.OK, "image/jpeg", _jpeg(session.images[rest], kind == "small"))
        elif kind == "mask" and rest in session.masks:
            self._send(HTTPStatus.OK, "image/png", _mask_png(session.masks[rest]))
        else:
            self._send_json(HTTPStatus.NOT_FOUND, {"error": "no such page"})

    def do_POST(self) -> None:
        length = int(self.headers.get("Content-Length") or 0)
        if not self._is_local_request() or length > MAX_REQUEST_BYTES:
            self._send_json(HTTPStatus.FORBIDDEN, {"error": "this page is for this machine only"})
            return
        try:
            request = json.loads(self.rfile.read(length) or b"{}")
            if self.path == "/mark":
                points = [(float(x), float(y)) for x, y in request["points"]]
                self.server.session.mark(str(request["view"]), points, request["sign"] == "+", float(request["radius"]))
                self._send_json(HTTPStatus.OK, self.server.state())
            elif self.path == "/remove":
                self.server.session.remove(int(request["index"]))
                self._send_json(HTTPStatus.OK, self.server.state())
            elif self.path == "/clear":
                self.server.session.clear(str(request["view"]))
                self._send_json(HTTPStatus.OK, self.server.state())
            elif self.path == "/save":
                self._send_json(HTTPStatus.OK, self.server.session.save())
            else:
                self._send_json(HTTPStatus.NOT_FOUND, {"error": "no such page"})
        except (ValueError, LookupError, TypeError, OSError) as error:
            self._send_json(HTTPStatus.BAD_REQUEST, {"error": str(error)})

    def _is_local_request(self) -> bool:
        """Return True if the request comes from this server's own page.

        Other pages in the same browser can send requests to this server too. Their requests have another origin or host
        name and are refused.
        """
        own = f"127.0.0.1:{self.server.server_address[1]}"
        local = (own, own.replace("127.0.0.1", "localhost"))
        origin = self.headers.get("Origin")
        return self.headers.get("Host") in local and (origin is None or urlsplit(origin).netloc in local)

    def _send_json(self, status: HTTPStatus, content: dict) -> None:
        self._send(status, "application/json", json.dumps(content).encode())

    def _send(self, status: HTTPStatus, kind: str, content: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", POLICY)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: object) -> None:
        """Ignore log messages of the server, because the terminal shows the progress of the fit."""


def _jpeg(image: np.ndarray, small: bool) -> bytes:
    picture, file = Image.fromarray(image), BytesIO()
    if small:
        picture.thumbnail((THUMBNAIL, THUMBNAIL))
    picture.save(file, "JPEG", quality=80 if small else 92)
    return file.getvalue()


def _mask_png(mask: np.ndarray) -> bytes:
    """Return a mask, bool [H, W], as PNG bytes: translucent inside, with an opaque border, transparent elsewhere."""
    inner = mask.copy()
    inner[1:-1, 1:-1] = mask[1:-1, 1:-1] & mask[:-2, 1:-1] & mask[2:, 1:-1] & mask[1:-1, :-2] & mask[1:-1, 2:]
    overlay = np.zeros((*mask.shape, 4), np.uint8)
    overlay[mask] = (*TINT, 110)
    overlay[mask & ~inner] = (*TINT, 255)
    file = BytesIO()
    Image.fromarray(overlay).save(file, "PNG", compress_level=1)
    return file.getvalue()


def stage_command(stage: str, arguments: argparse.Namespace) -> list[str]:
    """Return the command line that runs a stage of a scene, even if the scene has no masks yet.

    The option `poses.clicks={}` announces that masks will come from clicks, so that the stages accept a scene without
    masks.

    Args:
        arguments: has the scene, `runs`, `profile`, `budget` and `set`. Its variant is ignored.
    """
    options = {"--profile": arguments.profile, "--budget": arguments.budget}
    flags = [word for name, value in options.items() if value for word in (name, value)]
    words = ["run", stage, "--scene", str(arguments.scene), "--runs", str(arguments.runs), *flags]
    return [sys.executable, "-m", "reffusion.command", *words, "--set", f"{arguments.set} poses.clicks={{}}"]


def main() -> None:
    parser = cli.scene_parser("mask", __doc__)
    parser.add_argument("--port", type=int, default=PORT, help="if it is in use, the next free one is taken")
    parser.add_argument("--profile", help="as for `run`; these three apply to the stages up to `fit`")
    parser.add_argument("--budget", help="as for `run`")
    parser.add_argument("--set", default="", help="as for `run`")
    arguments = parser.parse_args()
    arguments.variant = ""  # a variant has the masks of its scene
    if status := subprocess.run(stage_command("raw_masks", arguments)).returncode:
        raise SystemExit(status)
    try:
        capture, segmenter = load_capture(cli.run_folder(arguments)), load_local_segmenter()
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None
    fit = subprocess.Popen(stage_command("fit", arguments))
    try:
        serve(Session(capture, lambda: fit.poll() == 0, segmenter), arguments, fit)
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None
    finally:
        fit.terminate()
        fit.wait()


def serve(session: Session, arguments: argparse.Namespace, fit: subprocess.Popen) -> None:
    """Print the page's address and serve the page until Ctrl-C.

    Args:
        session: marks and masks of the page.
        arguments: `port` is the first port to try; `scene` and `profile` are for the command that the page suggests.
        fit: process of the stage `fit`.

    Raises:
        ValueError: no port is free.
    """
    profile = f" profile={arguments.profile}" if arguments.profile else ""
    server = Server(session, arguments.port, fit, f"make scene={arguments.scene}{profile} all")
    port = server.server_address[1]
    print(f"{server.address}  (Ctrl-C ends)", flush=True)
    print(
        f"from another machine: `ssh -L {port}:localhost:{port} THIS_MACHINE`, then open this address there", flush=True
    )
    if session.segmenter is None:
        print("clicks are segmented by colours and surfaces; with the network of `make weights` (37 MB) fewer suffice")
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        pass


if __name__ == "__main__":
    main()
