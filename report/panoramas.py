"""Cut 360-degree panoramas, or a 360-degree video, into perspective views and place them: a folder that `run` takes.

`reffusion panoramas FOLDER --out VIEWS` writes VIEWS/images/<direction>/ and VIEWS/sparse/0.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from reffusion.capture.cut_panoramas import check_empty, cut_panoramas
from reffusion.capture.layouts.capture import find_image_folder, find_pictures
from reffusion.capture.layouts.panoramas import IMAGE_FOLDERS
from reffusion.capture.video_frames import extract_frames
from reffusion.command import root, scene_path
from report import cli


@cli.command
def main() -> None:
    """Run `reffusion panoramas`: cut panoramas into views, and print what was written."""
    parser = argparse.ArgumentParser(prog="reffusion panoramas", description=__doc__.split("\n")[0])
    parser.add_argument("scene", help="folder of panoramas, or a video of them; the name or path of a scene")
    parser.add_argument("--out", type=Path, help="folder to write; otherwise that of the scene, with -views at its end")
    arguments = parser.parse_args()
    print(make(arguments.scene, arguments.out))


def make(scene: str, out: Path | None) -> str:
    """Cut the panoramas of a folder or video into views (`cut_panoramas`); return a text to print.

    Args:
        scene: name or path of the folder or video. The frames of a video are written to <out>-frames.
        out: folder to write, which must not exist or be empty; None for <name of the scene>-views beside the scene.

    Raises:
        ValueError: there is no such scene, it holds no panoramas, the video is unusable, `out` is not empty, or the
            panoramas cannot be placed.
    """
    source = scene_path(scene, root())
    if source is None:
        raise ValueError(f"{scene}: no such folder or video")
    out = out or source.with_name(f"{source.stem}-views")
    check_empty(out)  # before the frames of a video are extracted
    if source.is_file():
        frames = out.with_name(f"{out.name}-frames")
        extract_frames(source, frames, "")
        source = frames
    folder = find_image_folder(source, None, IMAGE_FOLDERS)
    return cut_panoramas(find_pictures(folder), out)


if __name__ == "__main__":
    main()
