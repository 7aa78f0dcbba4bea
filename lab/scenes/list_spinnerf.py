"""Print a line for each of SPIn-NeRF's scenes in a folder: `python -m lab.scenes.list_spinnerf --data FOLDER`.

A line has the numbers of views and the parts that the scene lacks, or says that a published scene is missing.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from reffusion.capture import spinnerf_scenes
from report import cli


@cli.command
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="the folder that holds the scenes")
    print("\n".join(spinnerf_scenes.summarize_scenes(parser.parse_args().data.expanduser())), flush=True)


if __name__ == "__main__":
    main()
