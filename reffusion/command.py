"""The command `reffusion`, for any folder: `reffusion plan|run|... --scene X` is the runner, `reffusion view|...` a
module of report/. `python -m reffusion.command` is the same.

Nothing but the standard library is imported here, so that the command starts at once.
"""

import runpy
import sys
from pathlib import Path

REPORTS = {
    "report": "report.job",
    "compare-page": "report.compare",
    "batch-page": "report.batch",
    "view": "report.view",
    "study": "report.study",
    "study-votes": "report.votes",
    "mask": "report.mask",
    "turntable": "report.turntable",
    "sheet": "report.sheet",
    "check": "report.check",
    "patch": "report.patch",
    "export": "report.export",
}  # every other word is the runner's


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


def main() -> None:
    module = REPORTS.get(" ".join(sys.argv[1:2]), "runner")
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
