"""Acceptance of redrawn and of wrong references: `python -m lab.studies.redrawn --captures ../shared/data`.

A reference is accepted if it shows the same scene from the same view as the view's photograph; the module
`reffusion.references.registration` decides this. The study tests these decisions. For every n-th view of each capture
(--every) it makes ten pictures that an autoencoder and other tools could make of the photograph; they must be accepted.
The photographs of the nearest views, one of them redrawn, and a photograph of another capture must be refused.
*Redrawn* means: with other high frequencies, as an autoencoder writes them.
The study prints the inlier ratios (shares of compared points that are at the same place as in the photograph), the
numbers of wrong decisions and, with --seconds, the time of a registration.
"""

from __future__ import annotations

import argparse
import io
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from reffusion.capture.load import load_capture
from reffusion.io.images import load_image
from reffusion.references import registration
from report import page

LONGER_SIDE = 640  # px to which photographs are reduced
NEAREST = 2  # number of neighboring views whose photographs are given as wrong references of each view
COMPARED = 4  # number of neighboring photographs with which a reference is compared
CHOSEN_ON = ("bear", "garden", "statue", "fox")  # captures on which thresholds were chosen; other captures only report


def redraw(photo: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return a picture with the low frequencies of a photograph and other high frequencies, like an autoencoder's.

    The high frequencies have the photograph's amplitudes and random phases.

    Args:
        photo: uint8 [H, W, 3].
        seed: seed of the phases.
    """
    height, width = photo.shape[:2]
    half = cv2.resize(photo, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    low = cv2.resize(half, (width, height), interpolation=cv2.INTER_CUBIC).astype(np.float32)
    high = np.fft.fft2(photo - low, axes=(0, 1))
    phase = np.angle(np.fft.fft2(np.random.default_rng(seed).normal(size=(height, width))))
    texture = np.fft.ifft2(np.abs(high) * np.exp(1j * phase)[..., None], axes=(0, 1)).real
    return _to_picture(low + texture)


def resize_to_multiple(image: np.ndarray, of: int) -> np.ndarray:
    """Resize a picture to the nearest size whose sides are both multiples of `of`."""
    size = [max(of, round(side / of) * of) for side in image.shape[1::-1]]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def compress(image: np.ndarray, quality: int = 60) -> np.ndarray:
    """Save a picture as JPEG with the given quality and read it again."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=quality)
    return np.array(Image.open(file).convert("RGB"))


def shift(image: np.ndarray, across: float, down: float) -> np.ndarray:
    """Return a picture shifted to the right by `across` px and down by `down` px, which may be fractions."""
    size = (image.shape[1], image.shape[0])
    return cv2.warpAffine(image, np.array([[1.0, 0, across], [0, 1, down]]), size, borderMode=cv2.BORDER_REPLICATE)


def sharpen(image: np.ndarray) -> np.ndarray:
    """Sharpen a picture by unsharp masking, with 100 % of a radius of 1.5 px."""
    return _to_picture(2 * image.astype(np.float32) - cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.5))


def tint(image: np.ndarray) -> np.ndarray:
    """Give a picture a warm color cast."""
    return _to_picture(image * np.array([1.08, 1.0, 0.88]) + np.array([0, 4, 8]))


def darken(image: np.ndarray) -> np.ndarray:
    """Reduce the brightness of a picture to nine tenths."""
    return _to_picture(image * 0.9)


def _to_picture(values: np.ndarray) -> np.ndarray:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


# Name -> edit that a common tool could make after an autoencoder has redrawn the picture.
VARIANTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "redrawn": lambda picture: picture,
    "sides multiples of 8": lambda picture: resize_to_multiple(picture, 8),
    "sides multiples of 64": lambda picture: resize_to_multiple(picture, 64),
    "JPEG 60": compress,
    "shifted by 4 px": lambda picture: shift(picture, 3.3, -2.2),
    "gain 0.9": darken,
    "sharpened": sharpen,
    "color cast": tint,
    "64, cast, JPEG 60": lambda picture: compress(tint(resize_to_multiple(picture, 64))),
    "8, shifted, gain, sharpened": lambda picture: sharpen(darken(shift(resize_to_multiple(picture, 8), -2.5, 3.1))),
}


@dataclass
class Photographs:
    """Photographs of a capture, reduced and read on demand, and the poses of its views.

    Attributes:
        files: view -> file of the photograph.
        upright: True if photographs are turned upright when they are read.
        world_to_camera: view -> pose [4, 4].
        pictures: view -> uint8 [H, W, 3], the photographs read so far.
    """

    files: dict[str, Path]
    upright: bool
    world_to_camera: dict[str, np.ndarray]
    pictures: dict[str, np.ndarray] = field(default_factory=dict)

    def picture(self, view: str) -> np.ndarray:
        """Return the reduced photograph of a view, uint8 [H, W, 3]."""
        if view not in self.pictures:
            image = load_image(self.files[view], self.upright)
            self.pictures[view] = reduce(image, LONGER_SIDE)
        return self.pictures[view]

    def nearest(self, view: str) -> list[str]:
        """Return the names of all other views, nearest first.

        The distance of another view is that of its center, divided by the median of the distances of all other views'
        centers, plus twice the angle between the optical axes in radians.
        """
        center = {name: -pose[:3, :3].T @ pose[:3, 3] for name, pose in self.world_to_camera.items()}
        others = [name for name in self.files if name != view]
        distance = {name: float(np.linalg.norm(center[name] - center[view])) for name in others}
        axis = self.world_to_camera[view][2, :3]
        cosine = {name: np.clip(self.world_to_camera[name][2, :3] @ axis, -1, 1) for name in others}
        usual = float(np.median(list(distance.values())))
        return sorted(others, key=lambda name: distance[name] / usual + 2 * np.arccos(cosine[name]))


def load_photographs(folder: Path) -> Photographs:
    """Load the photographs and poses of a capture.

    Raises:
        ValueError: the capture has no poses.
    """
    capture = load_capture(folder)
    if capture.poses is None:
        raise ValueError(f"{folder} brings no poses: neighbouring views are not known")
    poses = {name: np.asarray(capture.poses.world_to_camera[name]) for name in capture.pictures}
    return Photographs(dict(capture.pictures), capture.upright, poses)


def reduce(image: np.ndarray, longer: int) -> np.ndarray:
    """Reduce the longer side of a picture to `longer` px; smaller pictures stay as they are."""
    size = [round(side * min(1, longer / max(image.shape[:2]))) for side in image.shape[1::-1]]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def make_hole(shape: Sequence[int], seed: int) -> np.ndarray:
    """Return a random rectangular hole, bool [H, W], whose sides are 15 to 35 % of the picture's sides."""
    random, (height, width) = np.random.default_rng(seed), shape[:2]
    high, wide = (int(side * random.uniform(0.15, 0.35)) for side in (height, width))
    top, left = random.integers(0, height - high), random.integers(0, width - wide)
    hole = np.zeros((height, width), bool)
    hole[top : top + high, left : left + wide] = True
    return hole


@dataclass
class Rates:
    """Inlier ratios of the registrations, and numbers of wrong decisions.

    Attributes:
        own: inlier ratios of pictures that must be accepted.
        other: inlier ratios of photographs of neighboring views.
        foreign: inlier ratios of the photograph of another capture.
        refused: number of right pictures that were refused.
        accepted_by_place: number of photographs of neighboring views that would be accepted by the inlier ratio alone,
            without comparison with other photographs.
        accepted: number of wrong pictures, of neighboring views and of another capture, that were accepted.
    """

    own: list[float] = field(default_factory=list)
    other: list[float] = field(default_factory=list)
    foreign: list[float] = field(default_factory=list)
    refused: int = 0
    accepted_by_place: int = 0
    accepted: int = 0

    def row(self, name: str) -> list[str]:
        """Return the row of a capture in the table whose head is `HEADER`."""
        own, other, foreign = (np.array(each) for each in (self.own, self.other, self.foreign))
        quantiles = lambda values, at: " / ".join(f"{100 * q:.1f}" for q in np.quantile(values, at))
        right = [str(len(own)), quantiles(own, (0, 0.01, 0.5)), str(self.refused)]
        wrong = [str(len(other)), quantiles(other, (0.5, 0.99, 1)), str(self.accepted_by_place), str(self.accepted)]
        return [name, *right, *wrong, str(len(foreign)), f"{100 * foreign.max():.1f}"]


HEADER = ("capture", "own", "in place, %: least / 1 % / median", "refused")
HEADER += ("neighbours", "in place, %: median / 99 % / most", "accepted by place", "accepted")
HEADER += ("other scenes", "in place, %: most")


def measure(capture: Photographs, foreign: np.ndarray, every: int) -> Rates:
    """Register right and wrong references for every n-th view of a capture, and count wrong decisions.

    Args:
        capture: the capture.
        foreign: uint8 [H, W, 3], a photograph of another capture.
        every: n.
    """
    rates = Rates()
    for index, view in enumerate(list(capture.files)[::every]):
        photo, nearest = capture.picture(view), capture.nearest(view)
        hole = make_hole(photo.shape, index)
        others = [(n, capture.picture(n), np.zeros(capture.picture(n).shape[:2], bool)) for n in nearest[:COMPARED]]
        redrawn = redraw(photo)
        for number, make in enumerate(VARIANTS.values()):
            image = fit_size(make(redrawn), photo)
            registered = registration.register(image, photo, hole)
            # To save time, only one variant per view is also compared with the photographs of neighboring views.
            compare = number == index % len(VARIANTS)
            wrong = not registered.fits or (compare and registration.find_better_view(image, registered, others))
            rates.own.append(registered.inlier_ratio)
            rates.refused += bool(wrong)
        for number, name in enumerate(nearest[:NEAREST]):
            image = fit_size(capture.picture(name) if number else redraw(capture.picture(name)), photo)
            registered = registration.register(image, photo, hole)
            rates.other.append(registered.inlier_ratio)
            rates.accepted_by_place += registered.fits
            rates.accepted += registered.fits and registration.find_better_view(image, registered, others) is None
        registered = registration.register(fit_size(foreign, photo), photo, hole)
        rates.foreign.append(registered.inlier_ratio)
        rates.accepted += registered.fits
    return rates


def fit_size(image: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Resize a picture to the size of the photograph, in the same way as the stage `reference`."""
    return cv2.resize(image, (photo.shape[1], photo.shape[0]), interpolation=cv2.INTER_CUBIC)


def measure_seconds(photo: np.ndarray) -> str:
    """Return a text with the CPU seconds of four registrations: a right and a wrong picture, each in two sizes.

    The longer side of the photograph is resized to 640 and to 1600 px.
    """
    parts = []
    for longer in (640, 1600):
        scale = longer / max(photo.shape[:2])
        image = cv2.resize(photo, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        hole = make_hole(image.shape, 0)
        for name, picture in (("its own", sharpen(shift(redraw(image), 2, 1))), ("another", image[:, ::-1].copy())):
            start = time.process_time()
            registration.register(picture, image, hole)
            parts.append(f"{longer} px, {name}: {time.process_time() - start:.2f} s")
    return "; ".join(parts)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=Path, default=Path("../shared/data"), help="folder of captures")
    parser.add_argument(
        "--names", default="bear,garden,statue,dinosaur,fox", help="names of captures, separated by commas"
    )
    parser.add_argument("--every", type=int, default=1, help="take every n-th view")
    parser.add_argument("--seconds", action="store_true", help="only measure the time of a registration")
    arguments = parser.parse_args()
    folders = [arguments.captures / name for name in arguments.names.split(",") if (arguments.captures / name).is_dir()]
    if len(folders) < 2:
        print(f"skipped: fewer than two captures in {arguments.captures}")
        return 0
    captures = {folder.name: load_photographs(folder) for folder in folders}
    first = {name: capture.picture(next(iter(capture.files))) for name, capture in captures.items()}
    if arguments.seconds:
        print(measure_seconds(next(iter(first.values()))))
        return 0
    names, rows = list(captures), []
    for name, capture in captures.items():
        foreign = first[names[names.index(name) - 1]]
        chosen = ", chosen on" if name in CHOSEN_ON else ""
        rows.append(measure(capture, foreign, arguments.every).row(name + chosen))
    print(page.markdown_table(HEADER, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
