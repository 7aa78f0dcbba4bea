"""A video as photographs: its sharpest frames, evenly spaced by how far the picture moves, as a scene's folder."""

from __future__ import annotations

import csv
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from reffusion import trace
from reffusion.capture.undistort import fitting_size
from reffusion.io.arrays import save_json
from reffusion.io.files import BadInput, reading
from reffusion.io.images import resized

MOST = 80  # frames: what is matched pair by pair within minutes
FEWEST = 12
SPACING = 0.04  # of the picture's width that it moves between two frames: neighbours share most of what they show
STILL = 0.25  # of the width: a picture that moves less in all shows everything from one place
LOOKED_AT = 3000  # frames at most, every so many of a long video
SHARP, FLOW = 640, 320  # px, the longer side at which sharpness and motion are measured
ANCHOR = 0.02  # of the width, from which motion is measured anew: a hand that trembles goes nowhere
CORNERS, KEPT = 200, 0.25  # that are followed; the share of them under which they are lost
PATIENCE, JUMP = 3, 0.3  # frames for which they may be, before all counts as new and as so far away
MIDDLE, ASIDE = 0.5, 0.6  # of its window; a frame outside counts as so much less sharp, so that few stand side by side
NEAR = 4  # windows to either side with whose frames one is compared
BLURRED = 0.4  # of the sharpness of those, under which it is left out
NOISE = 4.0  # of the Laplacian's variance, levels of 255 squared: rounding and coding leave so much in a plain picture
TOO_BLURRED = 0.003  # sharpness; photographs of grass, stone and rooms have 0.5 to 0.9, blurred by 2 px 0.003 to 0.01
QUALITY = 95  # of the JPEGs: the video lost more
RECORD, TABLE = "frames.json", "frames.csv"
TAKEN, LESS_SHARP, SOFT = "taken", "another nearby is sharper", "blurred like all nearby"


@dataclass(frozen=True)
class Seen:
    """A frame that was looked at.

    Attributes:
        number: of the frame in the file, from 0.
        seconds: its time.
        sharpness: variance of the Laplacian over that of the brightness, at `SHARP` px.
        way: by how much of its width the picture has moved since the first frame.
    """

    number: int
    seconds: float
    sharpness: float
    way: float


def take(video: Path, folder: Path, content: str) -> str:
    """Write the video's frames to folder/images, all that was looked at to frames.csv, and frames.json, last.

    The same file gives the same frames. Rotation that the file declares is obeyed.

    Args:
        content: a hash of the file, for frames.json.
    Returns:
        What was taken and what was not, in a sentence.
    Raises:
        BadInput: it is no video, too short, shows the same all the time, or is blurred throughout.
    """
    seen = look(video)
    if not seen:
        raise BadInput(
            f"{video}: OpenCV opens it and decodes no frame of it (codec {_codec(video)}); convert it, as in "
            f"`ffmpeg -i {video.name} -c:v libx264 {video.stem}-h264.mp4`"
        )
    if len(seen) < FEWEST:
        raise BadInput(f"{video}: {len(seen)} frames; a video that walks around the scene has hundreds")
    if seen[-1].way < STILL:
        raise BadInput(
            f"{video}: the picture moves by {seen[-1].way:.0%} of its width in all; walk around the object as you film"
        )
    chosen, soft = choose(seen)
    if np.median([each.sharpness for each in chosen]) < TOO_BLURRED:
        raise BadInput(f"{video}: blurred throughout; film slower, in more light, with the focus held on the scene")
    size = _write(video, folder / "images", chosen)
    said = f"{len(chosen)} of {len(seen)} frames of {video.name}, the sharpest of every {_spacing(seen):.0%} of the "
    said += f"width that the picture moves; {len(soft)} places left out, blurred all along"
    _save_table(folder / TABLE, seen, chosen, soft)
    facts = {"frames": len(seen), "seconds": seen[-1].seconds, "size": list(size), "taken": len(chosen)}
    facts |= {"blurred": len(soft), "said": said}
    save_json(folder / RECORD, {"video": str(video), "content": content, **facts})
    return said


def look(video: Path) -> list[Seen]:
    """How sharp the frames are, and how far the picture has moved; of a long video every few."""
    count = _count(video)
    every, way, seen = max(1, -(-count // LOOKED_AT)), _Way(), []
    frames = _frames(video, lambda number: number % every == 0)
    for _, (number, seconds, frame) in zip(trace.progress(-(-count // every), "frames"), frames, strict=False):
        gray = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        at = lambda longest, gray=gray: resized(gray, fitting_size(gray.shape[1], gray.shape[0], longest))
        sharp = sharpness(at(SHARP))
        seen.append(Seen(number, seconds, sharp, way.moved(at(FLOW), sharp)))
    return seen


def _count(video: Path) -> int:
    """Its frames; where the file does not say, as browsers' recordings do not, by going through it."""
    opened = _opened(video)
    count = int(opened.get(cv2.CAP_PROP_FRAME_COUNT))
    if count <= 0:
        count = sum(1 for _ in iter(opened.grab, False))
    opened.release()
    return count


def _codec(video: Path) -> str:
    """Four letters, as `av01`."""
    opened = _opened(video)
    code = int(opened.get(cv2.CAP_PROP_FOURCC))
    opened.release()
    return "".join(letter for k in range(4) if (letter := chr(code >> 8 * k & 255)).isalnum()) or "unknown"


def sharpness(gray: np.ndarray) -> float:
    """Of a grey picture, uint8 [H, W]: 0 where it is plain."""
    return max(0.0, float((cv2.Laplacian(gray, cv2.CV_32F).var() - NOISE) / (gray.var() + NOISE)))


class _Way:
    """How far a picture has moved: by corners followed from an anchor, which is renewed where they have moved on."""

    def __init__(self) -> None:
        self._anchor: np.ndarray | None = None
        self._corners: np.ndarray | None = None
        self._sharpness = self._before = self._longest = 0.0
        self._lost = 0

    def moved(self, gray: np.ndarray, sharp: float) -> float:
        """With the next frame, grey uint8 [H, W], and its sharpness: how far up to now, in widths; never less than
        before."""
        step = self._since(gray)
        if self._corners is None or self._lost > PATIENCE:
            self._renew(gray, sharp, JUMP if self._lost else 0.0)
        elif step >= (ANCHOR if sharp >= BLURRED * self._sharpness else 3 * ANCHOR):  # few corners last in a smear
            self._renew(gray, sharp, step)
        else:
            self._longest = max(self._longest, self._before + step)
        return self._longest

    def _renew(self, gray: np.ndarray, sharp: float, step: float) -> None:
        self._before += step
        self._longest, self._lost = max(self._longest, self._before), 0
        self._anchor, self._sharpness = gray, sharp
        self._corners = cv2.goodFeaturesToTrack(gray, CORNERS, 0.01, 8)

    def _since(self, gray: np.ndarray) -> float:
        """From the anchor; 0 where it is lost, or plain."""
        if self._corners is None:
            return 0.0
        found, there, _ = cv2.calcOpticalFlowPyrLK(self._anchor, gray, self._corners, None)
        there = there.ravel() > 0
        if there.sum() < max(8, KEPT * len(there)):
            self._lost += 1
            return 0.0
        self._lost = 0
        return float(np.median(np.linalg.norm((found - self._corners).reshape(-1, 2)[there], axis=1)) / gray.shape[1])


def _spacing(seen: list[Seen]) -> float:
    """The way between two frames that are taken."""
    return seen[-1].way / min(MOST, max(FEWEST, round(seen[-1].way / SPACING)))


def choose(seen: list[Seen]) -> tuple[list[Seen], list[Seen]]:
    """Of windows of equal way each the sharpest frame, and those of them that are blurred next to their neighbours."""
    spacing = _spacing(seen)
    windows: dict[int, list[Seen]] = {}
    for each in seen:
        windows.setdefault(min(int(each.way / spacing), round(seen[-1].way / spacing) - 1), []).append(each)
    best = []
    for number, frames in sorted(windows.items()):
        central = lambda each, number=number: abs(each.way / spacing - number - 0.5) <= MIDDLE / 2
        best.append(max(frames, key=lambda each: each.sharpness * (1 if central(each) else ASIDE)))
    chosen, soft = [], []
    for k, each in enumerate(best):
        usual = np.median([other.sharpness for other in best[max(0, k - NEAR) : k + NEAR + 1]])
        (chosen if each.sharpness >= BLURRED * usual else soft).append(each)
    return chosen, soft


def _write(video: Path, folder: Path, chosen: list[Seen]) -> tuple[int, int]:
    """Write the frames as frame_<number>.jpg; their (width, height)."""
    wanted, size = {each.number for each in chosen}, (0, 0)
    partial = folder.with_name(f".{folder.name}-{os.getpid()}")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    for number, _, frame in _frames(video, wanted.__contains__):
        picture = cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
        size = (picture.shape[1], picture.shape[0])
        Image.fromarray(picture).save(partial / f"frame_{number:05d}.jpg", quality=QUALITY, subsampling=0)
        if number >= chosen[-1].number:
            break
    shutil.rmtree(folder, ignore_errors=True)
    partial.replace(folder)
    return size


def _frames(video: Path, wanted: Callable[[int], bool]) -> Iterator[tuple[int, float, np.ndarray]]:
    """Number, seconds and picture, uint8 [H, W, 3] BGR, of the frames whose number is `wanted`."""
    opened, number = _opened(video), 0
    while opened.grab():
        if wanted(number):
            seconds = opened.get(cv2.CAP_PROP_POS_MSEC) / 1000
            whole, frame = opened.retrieve()
            if whole and frame is not None and frame.ndim == 3:
                yield number, seconds, frame
        number += 1
    opened.release()


def _opened(video: Path) -> cv2.VideoCapture:
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # what they say on standard error is in our line
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    with reading(video, "a video that OpenCV reads"):
        opened = cv2.VideoCapture(str(video), cv2.CAP_FFMPEG)
        if not opened.isOpened():
            raise BadInput(f"{video}: not a video that OpenCV reads; mp4, mov, mkv and webm are")
    opened.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
    return opened


def _save_table(path: Path, seen: list[Seen], chosen: list[Seen], soft: list[Seen]) -> None:
    what = {each.number: TAKEN for each in chosen} | {each.number: SOFT for each in soft}
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("frame", "seconds", "way", "sharpness", "what"))
        for each in seen:
            numbers = (f"{each.seconds:.3f}", f"{each.way:.4f}", f"{each.sharpness:.4f}")
            writer.writerow((each.number, *numbers, what.get(each.number, LESS_SHARP)))
