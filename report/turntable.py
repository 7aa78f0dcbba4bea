"""Video around a finished scene: `python -m report.turntable --scene demo` (`make scene=X turntable`)."""

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
# Codec of the .webm, which browsers play and OpenCV's wheels write; OpenCV's warning about the tag is harmless.
CODEC = "VP90"


def make(home: Path, frames: int = FRAMES) -> Path:
    """Render the result along a closed camera path, write the frames as `home`/turntable.webm, and return this path.

    The camera path is `camera_path.ellipse_path`, an ellipse through the capture.

    Args:
        home: runs/<scene> or runs/<scene>@<variant>, with a finished stage `evaluate`.
        frames: number of frames, at `RATE` frames per second.

    Raises:
        ValueError: the stage `evaluate` has not run, or the installed OpenCV cannot write this kind of video.
    """
    result = home / "evaluate" / "scene.ply"
    if not result.exists():
        raise ValueError(f"{result} is missing; `make scene={home.name.split('@')[0]} all` makes it")
    scene = load_scene(home.with_name(home.name.split("@")[0]) / "poses")
    gaussians = load_ply(result, scene.similarity)
    train = [scene.cameras[name] for name in scene.train]
    path, cameras = home / "turntable.webm", camera_path.ellipse_path(train, scene.points, frames)
    save_video(path, (to_uint8(rasterizer.render(gaussians, camera).color.numpy()) for camera in cameras))
    return path


def save_video(path: Path, pictures: Iterable[np.ndarray], rate: int = RATE) -> None:
    """Save pictures as a .webm video.

    Args:
        pictures: at least one, uint8 [H, W, 3] RGB, all of one size.
        rate: frames per second.

    Raises:
        ValueError: the installed OpenCV cannot write this kind of video.
    """
    writer = None
    for picture in pictures:
        if writer is None:
            size = (picture.shape[1], picture.shape[0])
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*CODEC), rate, size)
        if not writer.isOpened():
            raise ValueError(
                f"{path}: this OpenCV cannot write {CODEC} video; `pip install opencv-contrib-python-headless`"
            )
        writer.write(np.ascontiguousarray(picture[..., ::-1]))
    if writer is not None:
        writer.release()


def main() -> None:
    arguments = cli.scene_parser("turntable", __doc__).parse_args()
    try:
        print(make(cli.run_folder(arguments)))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None


if __name__ == "__main__":
    main()
