"""A flight around a finished scene as a video: `python -m report.turntable --scene demo` (`make scene=X turntable`)."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from reffusion.io.images import to_uint8
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_scene
from reffusion.splat import rasterizer
from report import command, flight

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
    path, cameras = home / "turntable.webm", flight.around(train, scene.points, frames)
    film = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*CODEC), RATE, (cameras[0].width, cameras[0].height))
    if not film.isOpened():
        raise ValueError(f"{path}: this OpenCV writes no {CODEC} video; `pip install opencv-contrib-python-headless`")
    for camera in cameras:
        picture = to_uint8(rasterizer.render(gaussians, camera).color.numpy())
        film.write(np.ascontiguousarray(picture[..., ::-1]))
    film.release()
    return path


def main() -> None:
    arguments = command.parser("turntable", __doc__).parse_args()
    try:
        print(make(command.home(arguments)))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None


if __name__ == "__main__":
    main()
