"""A flight around a finished scene as a video: `python -m report.turntable --scene demo` (`make scene=X turntable`)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from reffusion.io.images import to_uint8
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_scene
from reffusion.splat import rasterizer
from report import camera_path, cli

FRAMES, RATE = 144, 24  # six seconds
# In a .webm: what browsers play and OpenCV's wheels write, with a complaint about the tag that means nothing.
CODEC = "VP90"


def make(home: Path, frames: int = FRAMES) -> Path:
    """Write turntable.webm beside the scene's stages, with the result on a way around the capture; its path.

    Args:
        home: runs/<scene> or runs/<scene>@<variant>, its stage `evaluate` finished.

    Raises:
        ValueError: that stage has not run, or this OpenCV writes no such video.
    """
    finished = home / "evaluate" / "scene.ply"
    if not finished.exists():
        raise ValueError(f"{finished} is missing; `make scene={home.name.split('@')[0]} all` makes it")
    scene = load_scene(home.with_name(home.name.split("@")[0]) / "poses")
    gaussians = load_ply(finished, scene.similarity)
    train = [scene.cameras[name] for name in scene.train]
    path, cameras = home / "turntable.webm", camera_path.ellipse_path(train, scene.points, frames)
    save_video(path, (to_uint8(rasterizer.render(gaussians, camera).color.numpy()) for camera in cameras))
    return path


def save_video(path: Path, pictures: Iterable[np.ndarray], rate: int = RATE) -> None:
    """Pictures uint8 [H, W, 3], at least one, as a .webm. Raises ValueError where this OpenCV writes none."""
    film = None
    for picture in pictures:
        if film is None:
            size = (picture.shape[1], picture.shape[0])
            film = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*CODEC), rate, size)
        if not film.isOpened():
            raise ValueError(
                f"{path}: this OpenCV writes no {CODEC} video; `pip install opencv-contrib-python-headless`"
            )
        film.write(np.ascontiguousarray(picture[..., ::-1]))
    if film is not None:
        film.release()


def main() -> None:
    arguments = cli.scene_parser("turntable", __doc__).parse_args()
    try:
        print(make(cli.run_folder(arguments)))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None


if __name__ == "__main__":
    main()
