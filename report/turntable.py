"""Video around a finished scene: `python -m report.turntable --scene demo` (`make scene=X turntable`)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from reffusion import trace
from reffusion.io.images import to_uint8
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_scene
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians
from report import camera_path, cli
from report.sheet import stage_folder

FRAMES, RATE = 144, 24  # six seconds
# Codec of the .webm, which browsers play and OpenCV's wheels write; OpenCV's warning about the tag is harmless.
CODEC = "VP90"
WIPE_FRAMES, WIPE_WIDTH, WIPE_MILLISECONDS = 60, 480, 80
FILM_WIDTH = 960  # px


def make(home: Path, frames: int = FRAMES) -> Path:
    """Render the result along a closed camera path, write the frames as `home`/turntable.webm, and return this path.

    The camera path is `camera_path.ellipse_path`, an ellipse through the capture.

    Args:
        home: runs/<scene> or runs/<scene>@<variant>, with a finished stage `evaluate`.
        frames: number of frames, at `RATE` frames per second.

    Raises:
        ValueError: the stage `evaluate` has not run, or the installed OpenCV cannot write this kind of video.
    """
    gaussians, cameras = load_result(home, frames)
    path = home / "turntable.webm"
    save_video(path, (_picture(gaussians, cameras[k]) for k in trace.progress(len(cameras), "turntable")))
    return path


def make_wipe(home: Path, frames: int = WIPE_FRAMES) -> Path:
    """Render before and after along the path of the video, and write `home`/before_after.webm and .webp.

    A line swings to and fro; left of it is the scene with the object. The video is as wide as the photographs, within
    `WIPE_WIDTH` to `FILM_WIDTH` px; the animated .webp is `WIPE_WIDTH` px wide.

    Args:
        home: as for `make`; the stage `fit` has run, too.
        frames: number of frames, `WIPE_MILLISECONDS` each.

    Returns:
        The path of the .webp.

    Raises:
        ValueError: a stage has not run, or the installed OpenCV cannot write this kind of video.
    """
    after, cameras = load_result(home, frames)
    fitted = stage_folder(home, "fit") / "gaussians.ply"
    if not fitted.exists():
        raise ValueError(f"{fitted} is missing: there are no Gaussians with the object")
    before, pictures = load_ply(fitted), []
    width = max(WIPE_WIDTH, min(FILM_WIDTH, cameras[0].width))
    for k in trace.progress(len(cameras), "before_after"):
        camera = cameras[k].resized(width, round(width * cameras[k].height / cameras[k].width))
        line = round(width * (0.5 + 0.42 * np.cos(2 * np.pi * k / len(cameras))))
        picture = _picture(after, camera)
        picture[:, :line] = _picture(before, camera)[:, :line]
        picture[:, line - 1 : line + 1] = 255
        pictures.append(picture)
    path = home / "before_after.webp"
    save_video(path.with_suffix(".webm"), pictures, round(1000 / WIPE_MILLISECONDS))
    size = (WIPE_WIDTH, round(WIPE_WIDTH * pictures[0].shape[0] / width))
    first, *rest = [Image.fromarray(picture).resize(size, Image.Resampling.LANCZOS) for picture in pictures]
    first.save(path, save_all=True, append_images=rest, loop=0, duration=WIPE_MILLISECONDS, quality=70, method=4)
    return path


def load_result(home: Path, frames: int) -> tuple[Gaussians, list[Camera]]:
    """Return the Gaussians of a finished scene, and the cameras of a closed path around it.

    Raises:
        ValueError: the stage `evaluate` has not run.
    """
    result = home / "evaluate" / "scene.ply"
    if not result.exists():
        raise ValueError(f"{result} is missing; `make scene={home.name.split('@')[0]} all` makes it")
    scene = load_scene(stage_folder(home, "poses"))
    train = [scene.cameras[name] for name in scene.train]
    return load_ply(result, scene.similarity), camera_path.ellipse_path(train, scene.points, frames)


def _picture(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Render a picture, uint8 [H, W, 3]."""
    return to_uint8(rasterizer.render(gaussians, camera).color.numpy())


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


@cli.command
def main() -> None:
    """Run `reffusion turntable`: write the video, or that of before and after, and print its path."""
    parser = cli.scene_parser("turntable", __doc__)
    parser.add_argument(
        "--before-after", action="store_true", help="a video and an animated picture of before and after"
    )
    arguments = parser.parse_args()
    print((make_wipe if arguments.before_after else make)(cli.run_folder(arguments)))


if __name__ == "__main__":
    main()
