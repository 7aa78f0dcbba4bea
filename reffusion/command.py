"""The command `reffusion`, for any folder; `python -m reffusion.command` is the same. Commands are the runner's, or a
module of report/.

Nothing but the standard library is imported here, so that the command starts at once.
"""

import runpy
import sys
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

# Name -> the module that does it, and what it does.
COMMANDS = {
    "plan": ("runner", "what would run, and why"),
    "run": ("runner", "the whole job (run all), or one stage and what it needs"),
    "mask": ("report.mask", "make masks from clicks, in a browser"),
    "check": ("report.check", "what is odd about photographs, masks and poses; each mask over its photograph"),
    "report": ("report.job", "a page: what was done, results, errors against seconds"),
    "view": ("report.view", "walk through the finished scene in a browser (extra `view`)"),
    "turntable": ("report.turntable", "a video of the finished scene"),
    "sheet": ("report.sheet", "pictures of test views side by side"),
    "export": ("report.export", "the finished scene for other tools: .ply, cameras, LoRA (extra `export`)"),
    "patch": ("report.patch", "fill what was deleted in a splat editor (extra `export`)"),
    "compare": ("runner", "the method, ablations and baselines on one scene or a folder of scenes"),
    "compare-page": ("report.compare", "its tables and pictures on a page"),
    "batch": ("runner", "every scene of a folder"),
    "batch-page": ("report.batch", "its results on a page"),
    "study": ("report.study", "paired clips for people to judge"),
    "study-votes": ("report.votes", "count their answers"),
    "weights": ("runner", "fetch the weights that a profile needs"),
    "verify": ("runner", "hash what was computed: is it as it was made?"),
    "clean": ("runner", "remove what was computed for a scene"),
    "gc": ("runner", "remove what no plan uses any more"),
}


def root() -> Path:
    """Where pipeline.yaml, stages/, runner/ and report/ are: in this package's `app` where it is installed, beside the
    package in a checkout."""
    here = Path(__file__).resolve().parent
    return here / "app" if (here / "app").is_dir() else here.parent


def installed(root: Path) -> bool:
    """Is `root` the folder `app` inside an installed package `reffusion`, and not a checkout, where both lie side by
    side?"""
    return root.parts[-2:] == ("reffusion", "app") and not (root / "reffusion").is_dir()


def workplace(root: Path) -> Path:
    """Where data/ and runs/ are: a checkout's root; the current folder where an installed version is used."""
    return Path.cwd() if installed(root) else root


def overview() -> str:
    """What `reffusion --help` prints."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {what}" for name, (_, what) in COMMANDS.items()]
    return "\n".join(
        [
            "usage: reffusion COMMAND --scene FOLDER [options]",
            "",
            "Remove an object from a 3D Gaussian scene and fill the hole, guided by one reference image.",
            "",
            *lines,
            "",
            "Options of a command: reffusion COMMAND --help. The first job: reffusion run all --scene FOLDER",
        ]
    )


def installed_version() -> str:
    try:
        return f"reffusion {version('reffusion')}"
    except PackageNotFoundError:  # a checkout that nobody installed
        return "reffusion (not installed)"


def main() -> None:
    asked = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if asked in ("--help", "-h", "help", "--version"):
        with suppress(BrokenPipeError):  # as in `reffusion --help | head`
            print(installed_version() if asked == "--version" else overview(), flush=True)
        return
    if asked not in COMMANDS:
        print(f"error: there is no command '{asked}'; `reffusion --help` lists them", file=sys.stderr)
        sys.exit(2)
    module, _ = COMMANDS[asked]
    if module != "runner":
        del sys.argv[1]
    sys.path.insert(0, str(root()))  # never this folder itself: its `io` and `types` would hide Python's own
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as end:  # told in a line
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
            sys.exit(2)
        raise


if __name__ == "__main__":
    main()
