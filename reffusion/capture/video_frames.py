"""Turns a video into photographs: its sharpest frames, evenly spaced by the motion of the picture.

The motion of the picture is measured by tracked corners, in widths of the picture. The motion since the first frame is
called the *distance* of a frame. The distance of the last frame is divided into equal *windows*; each window gives at
most one frame.

The runner starts it as `python -m reffusion.capture.video_frames VIDEO FOLDER HASH`, see `extract_frames`.
"""

from __future__ import annotations

import csv
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from reffusion import trace
from reffusion.capture.layouts.unread import ARCHIVES
from reffusion.io.arrays import save_json
from reffusion.io.files import BadInput, reading
from reffusion.io.images import ENDINGS, fitting_size, resize_image
from reffusion.io.splats import FORMATS

MOST = 80  # largest number of selected frames: all their pairs can be matched within minutes
FEWEST = 12  # smallest number of windows, and of frames that a video must have
SPACING = 0.04  # distance between selected frames, in widths: neighbors still show mostly the same
STILL = 0.25  # widths: a video whose picture moves less in total was taken from one place
LOOKED_AT = 3000  # largest number of measured frames; in longer videos only every n-th is measured
SHARP, FLOW = 640, 320  # px, longer side of the reduced frames for measuring sharpness, and motion
ANCHOR = 0.02  # widths of motion after which the anchor frame is renewed; the trembling of a hand does not add up
CORNERS, KEPT = 200, 0.25  # number of tracked corners; if a smaller share of them is found again, tracking failed
PATIENCE, JUMP = 3, 0.3  # frames in a row in which tracking may fail; widths of motion assumed after more of them
MIDDLE, ASIDE = 0.5, 0.6  # central share of a window; factor for sharpness outside, so that frames are far apart
NEAR = 4  # windows on either side, with whose frames the sharpness of a frame is compared
BLURRED = 0.4  # ratio to their median sharpness, below which a frame is left out
NOISE = 4.0  # (levels of 255)^2: variance of the Laplacian of a plain picture, from rounding and compression
# Median sharpness of the selected frames, below which a video is refused. Photographs of grass, stone and rooms have
# 0.5 to 0.9; blurred by 2 px they have 0.003 to 0.01.
TOO_BLURRED = 0.003
QUALITY = 95  # of the JPEGs; compression of the video lost more
RECORD, TABLE = "frames.json", "frames.csv"
TAKEN, LESS_SHARP, SOFT = "taken", "another nearby is sharper", "blurred like all nearby"


@dataclass(frozen=True)
class FrameStats:
    """The measurements of a video frame.

    Attributes:
        number: number of the frame in the file, from 0.
        seconds: time of the frame in the video.
        sharpness: variance of the Laplacian over variance of the brightness, at `SHARP` px (`sharpness`).
        distance: motion of the picture since the first frame, in widths of the picture.
    """

    number: int
    seconds: float
    sharpness: float
    distance: float


def extract_frames(video: Path, folder: Path, content: str) -> str:
    """Select the sharpest frames of a video and write them as pictures.

    Writes the frames as frame_<number>.jpg to images/ in `folder`, the measurements of all measured frames to
    frames.csv, and at the end frames.json, a summary. An existing images/ is replaced. The same file gives the same
    frames. A rotation that the video file declares is applied.

    Args:
        content: a hash of the video file, which is written to frames.json.

    Returns:
        A sentence about the frames that were taken and those that were left out.

    Raises:
        BadInput: the file is no video, is too short, has a picture that hardly moves, or is blurred throughout. If the
            file is an archive, splats or a picture, the message says what to give instead.
    """
    _refuse_other_files(video)
    seen = measure_frames(video)
    if not seen:
        raise BadInput(
            f"{video}: OpenCV opens it and decodes no frame of it (codec {_codec(video)}); convert it, as in "
            f"`ffmpeg -i {video.name} -c:v libx264 {video.stem}-h264.mp4`"
        )
    if len(seen) < FEWEST:
        raise BadInput(f"{video}: {len(seen)} frames; a video that walks around the scene has hundreds")
    if seen[-1].distance < STILL:
        raise BadInput(
            f"{video}: the picture moves by {seen[-1].distance:.0%} of its width in all; walk around the object as you "
            "film"
        )
    chosen, blurred = select_frames(seen)
    if np.median([each.sharpness for each in chosen]) < TOO_BLURRED:
        raise BadInput(f"{video}: blurred throughout; film slower, in more light, with the focus held on the scene")
    size = _write(video, folder / "images", chosen)
    sentence = (
        f"{len(chosen)} of {len(seen)} frames of {video.name}, the sharpest of every {_spacing(seen):.0%} of the "
    )
    sentence += f"width that the picture moves; {len(blurred)} places left out, blurred all along"
    _save_table(folder / TABLE, seen, chosen, blurred)
    facts = {"frames": len(seen), "seconds": seen[-1].seconds, "size": list(size), "taken": len(chosen)}
    facts |= {"blurred": len(blurred), "said": sentence}
    save_json(folder / RECORD, {"video": str(video), "content": content, **facts})
    return sentence


def _refuse_other_files(path: Path) -> None:
    """Raise BadInput if a file, given in place of a scene's folder, is an archive, Gaussians or a picture."""
    name = path.name.lower()
    if name.endswith(ARCHIVES):
        raise BadInput(
            f"{path}: an archive; unpack it, and give the folder: scene={path.parent / path.name.split('.')[0]}"
        )
    if name.endswith((*FORMATS, ".ksplat", ".sog")):
        raise BadInput(
            f"{path}: a file of splats or points, and a scene has photographs; to fill what was deleted in an editor: "
            "`reffusion patch before.ply after.ply --out patched.ply`"
        )
    if name.endswith(ENDINGS):
        raise BadInput(f"{path}: one picture; give the folder that holds the photographs: scene={path.parent}")


def measure_frames(video: Path) -> list[FrameStats]:
    """Return the sharpness and distance of each frame, or of every n-th frame if there are more than `LOOKED_AT`.

    Frames that cannot be decoded are left out. Raises BadInput if the video cannot be opened.
    """
    count = _count(video)
    every, way, seen = max(1, -(-count // LOOKED_AT)), _MotionTracker(), []
    frames = _frames(video, lambda number: number % every == 0)
    for _, (number, seconds, frame) in zip(trace.progress(-(-count // every), "frames"), frames, strict=False):
        gray = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        at = lambda longest, gray=gray: resize_image(gray, fitting_size(gray.shape[1], gray.shape[0], longest))
        sharp = sharpness(at(SHARP))
        seen.append(FrameStats(number, seconds, sharp, way.update(at(FLOW), sharp)))
    return seen


def _count(video: Path) -> int:
    """Return the number of frames. If the file does not tell it (recordings of browsers), the frames are counted."""
    video_file = _open_video(video)
    count = int(video_file.get(cv2.CAP_PROP_FRAME_COUNT))
    if count <= 0:
        count = sum(1 for _ in iter(video_file.grab, False))
    video_file.release()
    return count


def _codec(video: Path) -> str:
    """Return the four letters of the video's codec, such as `av01`; "unknown" if there are none."""
    video_file = _open_video(video)
    code = int(video_file.get(cv2.CAP_PROP_FOURCC))
    video_file.release()
    return "".join(letter for k in range(4) if (letter := chr(code >> 8 * k & 255)).isalnum()) or "unknown"


def sharpness(gray: np.ndarray) -> float:
    """Return the sharpness of a gray picture, uint8 [H, W]; 0 if it is plain.

    The sharpness is (variance of the Laplacian - `NOISE`) / (variance of the brightness + `NOISE`).
    """
    return max(0.0, float((cv2.Laplacian(gray, cv2.CV_32F).var() - NOISE) / (gray.var() + NOISE)))


class _MotionTracker:
    """Measures the motion of a video's picture, by tracking corners from an anchor frame to later frames.

    When the corners have moved by `ANCHOR`, the current frame becomes the anchor.
    """

    def __init__(self) -> None:
        self._anchor: np.ndarray | None = None
        self._corners: np.ndarray | None = None
        self._sharpness = self._before = self._longest = 0.0
        self._lost = 0

    def update(self, gray: np.ndarray, sharp: float) -> float:
        """Add the next frame and return its distance: the motion since the first frame, which never decreases.

        Args:
            gray: gray picture of the frame, uint8 [H, W].
            sharp: sharpness of the frame.

        Returns:
            The distance in widths of the picture.
        """
        step = self._distance_from_anchor(gray)
        if self._corners is None or self._lost > PATIENCE:
            self._renew(gray, sharp, JUMP if self._lost else 0.0)
        # A blurred frame becomes the anchor later, since few of its corners can be tracked.
        elif step >= (ANCHOR if sharp >= BLURRED * self._sharpness else 3 * ANCHOR):
            self._renew(gray, sharp, step)
        else:
            self._longest = max(self._longest, self._before + step)
        return self._longest

    def _renew(self, gray: np.ndarray, sharp: float, step: float) -> None:
        """Make the frame `gray` the anchor. `step`: motion since the old anchor, in widths."""
        self._before += step
        self._longest, self._lost = max(self._longest, self._before), 0
        self._anchor, self._sharpness = gray, sharp
        self._corners = cv2.goodFeaturesToTrack(gray, CORNERS, 0.01, 8)

    def _distance_from_anchor(self, gray: np.ndarray) -> float:
        """Return the corners' median motion since the anchor, in widths; 0 if tracking fails or without corners."""
        if self._corners is None:
            return 0.0
        found, tracked, _ = cv2.calcOpticalFlowPyrLK(self._anchor, gray, self._corners, None)
        tracked = tracked.ravel() > 0
        if tracked.sum() < max(8, KEPT * len(tracked)):
            self._lost += 1
            return 0.0
        self._lost = 0
        return float(np.median(np.linalg.norm((found - self._corners).reshape(-1, 2)[tracked], axis=1)) / gray.shape[1])


def _spacing(seen: list[FrameStats]) -> float:
    """Return the size of a window, about the distance between two selected frames, in widths of the picture."""
    return seen[-1].distance / min(MOST, max(FEWEST, round(seen[-1].distance / SPACING)))


def select_frames(seen: list[FrameStats]) -> tuple[list[FrameStats], list[FrameStats]]:
    """Select at most one frame of each window of equal distance.

    The candidate of a window is its sharpest frame; sharpness outside the window's middle counts less (`ASIDE`). A
    candidate is blurred if its sharpness is below `BLURRED` times the median of the candidates around it.

    Args:
        seen: the measured frames, in order; the distance of the last one is above 0.

    Returns:
        The selected frames, and the blurred candidates, which are left out.
    """
    spacing = _spacing(seen)
    windows: dict[int, list[FrameStats]] = {}
    for each in seen:
        windows.setdefault(min(int(each.distance / spacing), round(seen[-1].distance / spacing) - 1), []).append(each)
    best = []
    for number, frames in sorted(windows.items()):
        central = lambda each, number=number: abs(each.distance / spacing - number - 0.5) <= MIDDLE / 2
        best.append(max(frames, key=lambda each: each.sharpness * (1 if central(each) else ASIDE)))
    chosen, blurred = [], []
    for k, each in enumerate(best):
        usual = np.median([other.sharpness for other in best[max(0, k - NEAR) : k + NEAR + 1]])
        (chosen if each.sharpness >= BLURRED * usual else blurred).append(each)
    return chosen, blurred


def _write(video: Path, folder: Path, chosen: list[FrameStats]) -> tuple[int, int]:
    """Write the chosen frames as frame_<number>.jpg to `folder`, which is replaced. Returns their (width, height)."""
    numbers, size = {each.number for each in chosen}, (0, 0)
    partial = folder.with_name(f".{folder.name}-{os.getpid()}")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    for number, _, frame in _frames(video, numbers.__contains__):
        picture = cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
        size = (picture.shape[1], picture.shape[0])
        Image.fromarray(picture).save(partial / f"frame_{number:05d}.jpg", quality=QUALITY, subsampling=0)
        if number >= chosen[-1].number:
            break
    shutil.rmtree(folder, ignore_errors=True)
    partial.replace(folder)
    return size


def _frames(video: Path, is_chosen: Callable[[int], bool]) -> Iterator[tuple[int, float, np.ndarray]]:
    """Yield number, time in seconds and picture, uint8 [H, W, 3] BGR, of frames whose numbers `is_chosen` accepts."""
    video_file, number = _open_video(video), 0
    while video_file.grab():
        if is_chosen(number):
            seconds = video_file.get(cv2.CAP_PROP_POS_MSEC) / 1000
            whole, frame = video_file.retrieve()
            if whole and frame is not None and frame.ndim == 3:
                yield number, seconds, frame
        number += 1
    video_file.release()


def _open_video(video: Path) -> cv2.VideoCapture:
    """Open a video; its frames will be rotated as the file declares. Raises BadInput if OpenCV cannot open it."""
    # no messages of the libraries on standard error: BadInput tells what is wrong
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    with reading(video, "a video that OpenCV reads"):
        video_file = cv2.VideoCapture(str(video), cv2.CAP_FFMPEG)
        if not video_file.isOpened():
            raise BadInput(f"{video}: not a video that OpenCV reads; mp4, mov, mkv and webm are")
    video_file.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
    return video_file


def _save_table(path: Path, seen: list[FrameStats], chosen: list[FrameStats], blurred: list[FrameStats]) -> None:
    """Write the measurements of all frames, and whether each was taken, as a CSV file."""
    what = {each.number: TAKEN for each in chosen} | {each.number: SOFT for each in blurred}
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("frame", "seconds", "way", "sharpness", "what"))
        for each in seen:
            numbers = (f"{each.seconds:.3f}", f"{each.distance:.4f}", f"{each.sharpness:.4f}")
            writer.writerow((each.number, *numbers, what.get(each.number, LESS_SHARP)))


if __name__ == "__main__":
    try:
        print(extract_frames(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]))
    except ValueError as error:
        print(" ".join(str(error).split()))
        sys.exit(1)
