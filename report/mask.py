"""Masks from clicks in a browser: `python -m report.mask --scene demo` (`make scene=X mask`).

The command runs the stages `poses` and `raw_masks`, then opens the page of `reffusion app` at its step for the object.
The stage `fit` runs in the background, because masks of all views need the fitted Gaussians.
"""

from __future__ import annotations

import argparse
import subprocess
from urllib.parse import quote

from report import cli
from report.app.app import App
from report.app.jobs import WITHOUT_MASKS, make_command
from report.app.server import PORT, Server, announce


def runner_options(arguments: argparse.Namespace) -> tuple[str, ...]:
    """Return the options --profile, --budget and --set that are given, as words of a command line."""
    options = {"--profile": arguments.profile, "--budget": arguments.budget, "--set": arguments.set}
    return tuple(word for name, value in options.items() if value for word in (name, value))


@cli.command
def main() -> None:
    """Run `reffusion mask`: run the stages up to `raw_masks`, then serve the page until Ctrl-C."""
    parser = cli.scene_parser("mask", __doc__)
    parser.add_argument("--port", type=int, default=PORT, help="if it is in use, the next free one is taken")
    parser.add_argument("--profile", help="as for `run`, also for jobs that the page starts")
    parser.add_argument("--budget", help="as for `run`")
    parser.add_argument("--set", default="", help="as for `run`")
    arguments = parser.parse_args()
    arguments.variant = ""  # a variant has the masks of its scene
    options = runner_options(arguments)
    words = ("run", "raw_masks", "--scene", str(arguments.scene), "--runs", str(arguments.runs), *options)
    if status := subprocess.run(make_command(*words, "--set", WITHOUT_MASKS)).returncode:
        raise SystemExit(status)
    app = App(arguments.runs.resolve(), options, cli.typed_command("mask", arguments.scene))
    serve(app, app.open(str(arguments.scene)).name, arguments.port)


def serve(app: App, scene: str, port: int) -> None:
    """Print the page's address and serve the page until Ctrl-C.

    Args:
        scene: name of the open scene whose object is marked.
        port: the first port to try.

    Raises:
        ValueError: no port is free, or clicks do not suit the scene's masks.
    """
    app.first = scene
    app.begin_masks(app.scenes[scene])
    server = Server(app, port)
    announce(server, server.link(fragment=f"{quote(scene)}/object"))
    step = app.scenes[scene].mask_step
    if step is not None and step.session.segmenter is None:
        print("clicks are segmented by colors and surfaces; with the network of `make weights` (37 MB) fewer suffice")
    server.serve()


if __name__ == "__main__":
    main()
