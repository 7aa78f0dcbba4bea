"""The command `reffusion` (or `python -m reffusion.command`), which starts the runner, or a module of report/ or lab/.

This module imports only the standard library, so that the command starts without delay.
"""

import runpy
import sys
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

# name -> (the module that it runs, help)
COMMANDS = {
    "demo": ("lab.scenes.generate", "make the demo scene, data/demo (demo --help: others)"),
    "plan": ("runner", "what would run, and why"),
    "run": ("runner", "run the whole job (run all), or one stage and what it needs"),
    "app": ("report.app", "one page from photographs to the finished scene, in a browser"),
    "mask": ("report.mask", "make masks from clicks, in a browser"),
    "check": ("report.check", "look for problems of photographs, masks and poses; draw each mask over its photograph"),
    "panoramas": ("report.panoramas", "cut 360-degree photographs or a video into views of known poses"),
    "report": ("report.job", "a page on a job: stages, results, errors against time"),
    "view": ("report.view", "view the finished scene in a browser (extra `view`)"),
    "turntable": ("report.turntable", "a video of the finished scene"),
    "sheet": ("report.sheet", "images of test views side by side"),
    "export": (
        "report.export",
        "export the finished scene: .ply, .spz, .glb, .sog, .html, cameras, LoRA (extra `export`)",
    ),
    "patch": ("report.patch", "fill what was deleted in a splat editor (extra `export`)"),
    "compare": ("runner", "run the method, ablations and baselines on one scene or a folder of scenes"),
    "compare-page": ("report.compare", "draw the page of a comparison again"),
    "batch": ("runner", "run every scene of a folder"),
    "batch-page": ("report.batch", "draw the page of a batch again"),
    "study": ("report.study", "make paired clips for people to judge"),
    "study-votes": ("report.votes", "count the answers of a study"),
    "doctor": ("report.doctor", "does each 2D inpainter on this machine work? time, memory, and a sheet"),
    "weights": ("runner", "fetch the weights that a profile needs"),
    "verify": ("runner", "hash all results: are they as they were made?"),
    "clean": ("runner", "remove the results of a scene"),
    "gc": ("runner", "remove results that no plan uses"),
}


def root() -> Path:
    """Return the folder that contains pipeline.yaml, stages/, runner/ and report/.

    In an installed package this is the folder `app` beside this file, else the top folder of the checkout.
    """
    here = Path(__file__).resolve().parent
    return here / "app" if (here / "app").is_dir() else here.parent


def is_installed(root: Path) -> bool:
    """Return whether `root` is the folder `app` of an installed package, rather than a checkout."""
    return root.parts[-2:] == ("reffusion", "app") and not (root / "reffusion").is_dir()


def workplace(root: Path) -> Path:
    """Return the folder that contains data/ and runs/.

    This is the top folder of a checkout, or the current working directory for an installed package.

    Args:
        root: the result of `root()`.
    """
    return Path.cwd() if is_installed(root) else root


def scene_path(text: str, root: Path) -> Path | None:
    """Return the folder or video that the name or path of a scene means, as an absolute path; None if there is none.

    Args:
        text: a name under data/, or else a path; None is returned for an empty text.
        root: the result of `root()`.
    """
    places = (workplace(root) / "data" / text, Path(text).expanduser())
    return next((place.resolve() for place in places if text and (place.is_dir() or place.is_file())), None)


def scene_name(scene: Path) -> str:
    """Return the name of a scene: that of its folder, or that of its video without the ending."""
    return scene.stem if scene.is_file() else scene.name


def overview() -> str:
    """Return the text of `reffusion --help`."""
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
    """Return the text of `reffusion --version`."""
    try:
        return f"reffusion {version('reffusion')}"
    except PackageNotFoundError:  # a checkout without an installation
        return "reffusion (not installed)"


def main() -> None:
    """Run the command that the command line names; without a name, print the text of `--help`.

    The process exits with status 2 if the name is unknown, or if the command exits with an error message. Such a
    message is printed without a traceback.
    """
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
    # not the folder of this file: its `io` and `types` would hide Python's modules
    sys.path.insert(0, str(root()))
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as end:  # print the message of an exit as one line, without a traceback
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
            sys.exit(2)
        raise


if __name__ == "__main__":
    main()
