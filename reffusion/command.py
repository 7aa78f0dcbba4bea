"""The command `reffusion` (or `python -m reffusion.command`): starts the runner or a module of report/.

Imports only the standard library, so that the command starts at once.
"""

import runpy
import sys
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

# name -> (the module that it runs, help)
COMMANDS = {
    "plan": ("runner", "what would run, and why"),
    "run": ("runner", "run the whole job (run all), or one stage and what it needs"),
    "mask": ("report.mask", "make masks from clicks, in a browser"),
    "check": ("report.check", "look for problems of photographs, masks and poses; draw each mask over its photograph"),
    "report": ("report.job", "a page on a job: stages, results, errors against time"),
    "view": ("report.view", "view the finished scene in a browser (extra `view`)"),
    "turntable": ("report.turntable", "a video of the finished scene"),
    "sheet": ("report.sheet", "images of test views side by side"),
    "export": ("report.export", "export the finished scene for other tools: .ply, cameras, LoRA (extra `export`)"),
    "patch": ("report.patch", "fill what was deleted in a splat editor (extra `export`)"),
    "compare": ("runner", "run the method, ablations and baselines on one scene or a folder of scenes"),
    "compare-page": ("report.compare", "draw the page of a comparison again"),
    "batch": ("runner", "run every scene of a folder"),
    "batch-page": ("report.batch", "draw the page of a batch again"),
    "study": ("report.study", "make paired clips for people to judge"),
    "study-votes": ("report.votes", "count the answers of a study"),
    "weights": ("runner", "fetch the weights that a profile needs"),
    "verify": ("runner", "hash all results: are they as they were made?"),
    "clean": ("runner", "remove the results of a scene"),
    "gc": ("runner", "remove results that no plan uses"),
}


def root() -> Path:
    """The folder with pipeline.yaml, stages/, runner/ and report/: `app` if installed, else the top of a checkout."""
    here = Path(__file__).resolve().parent
    return here / "app" if (here / "app").is_dir() else here.parent


def is_installed(root: Path) -> bool:
    """Whether `root` is the folder `app` of an installed package, and not a checkout."""
    return root.parts[-2:] == ("reffusion", "app") and not (root / "reffusion").is_dir()


def workplace(root: Path) -> Path:
    """The folder with data/ and runs/: the top of a checkout, or the current folder for an installed package."""
    return Path.cwd() if is_installed(root) else root


def overview() -> str:
    """The text of `reffusion --help`."""
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
    """The text of `reffusion --version`."""
    try:
        return f"reffusion {version('reffusion')}"
    except PackageNotFoundError:  # a checkout without an installation
        return "reffusion (not installed)"


def main() -> None:
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in ("--help", "-h", "help", "--version"):
        with suppress(BrokenPipeError):  # as in `reffusion --help | head`
            print(installed_version() if name == "--version" else overview(), flush=True)
        return
    if name not in COMMANDS:
        print(f"error: there is no command '{name}'; `reffusion --help` lists them", file=sys.stderr)
        sys.exit(2)
    module, _ = COMMANDS[name]
    if module != "runner":
        del sys.argv[1]
    sys.path.insert(0, str(root()))  # not this folder: its `io` and `types` would hide those of Python
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as end:  # with a message: one line, without a traceback
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
            sys.exit(2)
        raise


if __name__ == "__main__":
    main()
