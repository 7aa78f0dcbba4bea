"""One page from photographs to the finished scene: `reffusion app` (`make app`)."""

from __future__ import annotations

import os
import sys
from urllib.parse import quote

from report import cli
from report.app.app import App
from report.app.server import PORT, Server, announce


@cli.command
def main() -> None:
    """Run `reffusion app`: serve the page until Ctrl-C, and print its address."""
    parser = cli.scene_parser("app", __doc__, needs_scene=False)
    parser.add_argument("--port", type=int, default=PORT, help="if it is in use, the next free one is taken")
    arguments = parser.parse_args()
    app = App(arguments.runs.resolve(), command=cli.typed_command("app", arguments.scene))
    if arguments.scene:
        app.first = app.open(str(arguments.scene)).name
    server = Server(app, arguments.port)
    announce(server, server.link(fragment=f"{quote(app.first)}/photographs" if app.first else ""))
    server.serve()
    sys.stdout.flush()
    os._exit(0)  # threads of onnxruntime may still compute, and abort the interpreter's usual end


if __name__ == "__main__":
    main()
