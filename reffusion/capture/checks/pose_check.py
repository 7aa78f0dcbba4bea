"""Finds photographs that contradict their poses: another picture under the same name, a pose that is wrong by degrees.

The sparse points connect the views: where two views see the same points, their pictures must show the same there. For
each view we take what its nearest views show at the points, place it where the view's pose projects the points, and
correlate it with the view's own picture at every shift of the picture. A right photograph correlates best without a
shift, by a wide margin, whatever its exposure and however few points it shares. A photograph that belongs elsewhere
correlates best at some other shift, or nowhere.

PAPER leaves open: it takes photographs and poses as given.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from reffusion.capture.image_detail import sample_visible
from reffusion.capture.roles import LEAST_TRAINING_VIEWS
from reffusion.geometry import project
from reffusion.io.images import to_gray
from reffusion.types import Camera, Scene

LONGER_SIDE = 128  # cells along a picture's longer side, at which pictures are compared
WINDOW = 12  # cells: variation over larger distances is brightness, not detail
NOISE = 4.0  # levels of 255: standard deviation in a window, well under which there is no detail
POINTS = 5000  # at most, that are compared
DENSITY = 12  # mean number of points per cell of the picture, so that the nearest hide those behind them
LEAST_SHARED = 50  # points that two compared views have in common
LEAST_POINTS = 250  # points that a view shares with all its neighbours together: with fewer, chance correlates too
NEIGHBOURS = 6  # views that each view is compared with
LEAST_NEIGHBOURS = 2  # with fewer, a view is not judged
# cosine of 35 degrees: views whose axes differ by more see other sides of things, and are not compared
TURN = np.cos(np.radians(35))
LEAST_DETAIL = 0.2  # root mean square of the detail at the points, under which the pictures are too plain
SAME, ELSEWHERE = 2, 4  # cells of shift up to which the pose is right, and from which it is wrong
LEAST_MARGIN = 0.1  # of the correlation at the pose over that at the best other shift; right views have 0.2 to 0.7
CLEAR = 0.6  # correlation at the pose from which another shift must be better, by this margin, to count
LEAST_OVERLAP = 0.5  # share of the points that a shift must leave in the picture


@dataclass(frozen=True)
class PoseCheck:
    """The result of `check_poses`.

    Attributes:
        judged: number of views that share enough with others to be judged.
        contradicting: sorted names of the views whose photographs contradict their poses.
    """

    judged: int
    contradicting: tuple[str, ...]

    @property
    def is_widespread(self) -> bool:
        """Do half of the views or more contradict the others? Then it cannot be told which of them are right."""
        return 2 * len(self.contradicting) >= max(self.judged, 1)


def check_poses(cameras: Sequence[Camera], points: np.ndarray, image_of: Callable[[str], np.ndarray]) -> PoseCheck:
    """Compare each photograph with those of the nearest views at the points that both see.

    The worst view is set aside and its neighbours are compared again, until the rest agree. In the end the views set
    aside are compared with the rest once more.

    Args:
        cameras: undistorted views in the normalised frame.
        points: [P, 3] sparse points or those of flow.
        image_of: view name -> uint8 [H, W, 3].
    """
    points = points[:: max(1, -(-len(points) // POINTS))]
    cells = max(4, round((len(points) / DENSITY) ** 0.5))
    views = {camera.name: _View.of(camera, points, image_of(camera.name), cells) for camera in cameras}
    order = {name: _nearest(view, views.values()) for name, view in views.items()}
    kept = set(views)
    around = lambda name: [other for other in order[name] if other in kept][:NEIGHBOURS]
    compare = lambda names: {name: _margin(views[name], [views[other] for other in around(name)]) for name in names}
    margins = compare(sorted(views))
    judged = sum(margin is not None for margin in margins.values())
    out: list[str] = []
    while 2 * len(out) < judged and (low := [(margins[name], name) for name in kept if _is_low(margins[name])]):
        worst = min(low)[1]
        affected = [name for name in kept if worst in around(name)]
        kept.remove(worst)
        out.append(worst)
        margins |= compare(affected)
    if 2 * len(out) < judged:
        again = compare(out)
        out = [name for name in out if again[name] is None or _is_low(again[name])]
    return PoseCheck(judged, tuple(sorted(out)))


def _is_low(margin: float | None) -> bool:
    return margin is not None and margin < LEAST_MARGIN


@dataclass(frozen=True)
class _View:
    """The picture of a view in cells, and what it shows at the points.

    Attributes:
        places: [P, 2] int, column and row of the cell that shows each point; valid where `seen`.
        seen: [P] bool, the visible points.
        detail: float32 [h, w], see `_detail`.
        values: float32 [P], the detail at the points; 0 where they are not seen.
    """

    camera: Camera
    places: np.ndarray
    seen: np.ndarray
    detail: np.ndarray
    values: np.ndarray

    @classmethod
    def of(cls, camera: Camera, points: np.ndarray, image: np.ndarray, cells: int) -> _View:
        detail = _detail(image)
        height, width = detail.shape
        at = project(points, camera)[0] * (width / camera.width, height / camera.height)
        enlarged = cv2.resize(detail, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)
        values = sample_visible(camera, points, enlarged[..., None], cells)[:, 0]
        seen = ~np.isnan(values)
        places = np.where(seen[:, None], at, 0).astype(int).clip(0, (width - 1, height - 1))
        return cls(camera, places, seen, detail, np.nan_to_num(values))

    @property
    def padded(self) -> tuple[int, int]:
        """Rows and columns of the Fourier transforms, so that no shift wraps around."""
        return 2 * self.detail.shape[0], 2 * self.detail.shape[1]

    @cached_property
    def spectra(self) -> list[np.ndarray]:
        """Fourier transforms of the detail, of its square, and of the picture's area."""
        pictures = (self.detail, self.detail**2, np.ones_like(self.detail))
        return [np.fft.rfft2(each, self.padded) for each in pictures]

    def distance(self, other: _View) -> float:
        """How differently two cameras look: distance of their centres, plus the angle between their axes in radians."""
        cosine = float(self.camera.world_to_camera[2, :3] @ other.camera.world_to_camera[2, :3])
        return float(np.linalg.norm(self.camera.center - other.camera.center) + np.arccos(np.clip(cosine, -1, 1)))


def _detail(image: np.ndarray) -> np.ndarray:
    """float32 [h, w]: local contrast of the brightness in cells, about -1 to 1.

    It is the brightness less its mean in a window, over its standard deviation there. So it does not depend on exposure
    and shading, and is near 0 where the picture is plain.
    """
    gray = to_gray(image)
    factor = LONGER_SIDE / max(gray.shape)
    size = max(1, round(gray.shape[1] * factor)), max(1, round(gray.shape[0] * factor))
    gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    detail = gray - cv2.blur(gray, (WINDOW, WINDOW))
    return detail / (np.sqrt(np.maximum(cv2.blur(detail**2, (WINDOW, WINDOW)), 0)) + NOISE)


def _nearest(view: _View, others: Collection[_View]) -> list[str]:
    """Names of the views that look in the same direction and share points with this one, the nearest first."""
    axis = view.camera.world_to_camera[2, :3]
    others = [each for each in others if each is not view and each.camera.world_to_camera[2, :3] @ axis > TURN]
    shared = [each for each in others if (each.seen & view.seen).sum() >= LEAST_SHARED]
    return [each.camera.name for each in sorted(shared, key=lambda each: (view.distance(each), each.camera.name))]


def _margin(view: _View, others: Sequence[_View]) -> float | None:
    """The correlation at the view's pose less that at the best other shift, and a bonus where it is clear; None where
    nothing can be said."""
    if len(others) < LEAST_NEIGHBOURS:
        return None
    count = sum(each.seen & view.seen for each in others)
    known = np.flatnonzero(count)
    expected = sum(np.where(view.seen, each.values, 0) for each in others)[known] / count[known]
    plain = min(np.sqrt(np.mean(each**2)) for each in (expected, view.values[known])) < LEAST_DETAIL
    if len(known) < LEAST_POINTS or plain:
        return None
    correlation, shift = _correlations(view, view.places[known], expected)
    here, elsewhere = correlation[shift <= SAME].max(), correlation[shift > ELSEWHERE].max()
    # A pattern that repeats, bricks or tiles, correlates as well one period on.
    return float(here - elsewhere + (2 * LEAST_MARGIN if here > CLEAR else 0))


def _correlations(view: _View, places: np.ndarray, expected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Correlation of `expected` [K] with the view's detail at the cells [K, 2], for every shift that keeps enough of
    them in the picture; and the lengths of these shifts in cells."""
    templates = np.zeros((3, *view.padded))
    for template, weight in zip(templates, (expected, np.ones_like(expected), expected**2), strict=True):
        np.add.at(template, (places[:, 1], places[:, 0]), weight)
    picture, square, area = view.spectra
    spectra = np.conj(np.fft.rfft2(templates))
    pairs = ((spectra[0], picture), (spectra[1], square), (spectra[2], area), (spectra[1], area))
    product, energy, template_energy, inside = (np.fft.irfft2(one * other, view.padded) for one, other in pairs)
    correlation = product / np.sqrt(np.maximum(energy, 1e-6) * np.maximum(template_energy, 1e-6))
    rows, columns = (np.minimum(np.arange(n), n - np.arange(n)) for n in view.padded)
    enough = inside >= LEAST_OVERLAP * len(places)
    return correlation[enough], np.hypot(rows[:, None], columns[None])[enough]


# ---------------------------------------------------------------------------------------------- what follows from it


@dataclass(frozen=True)
class Verdict:
    """What follows from a `PoseCheck`.

    Attributes:
        outliers: training views to leave out of the scene, sorted.
        suspects: views that contradict their poses and stay: test views, clean views, and all if too few would be left.
        sentences: what the user should know, with the line of scene.yaml that decides otherwise.
    """

    outliers: tuple[str, ...] = ()
    suspects: tuple[str, ...] = ()
    sentences: tuple[str, ...] = ()

    def apply(self, scene: Scene) -> Scene:
        """The scene without the outliers."""
        return replace(
            scene,
            cameras={name: camera for name, camera in scene.cameras.items() if name not in self.outliers},
            train=tuple(name for name in scene.train if name not in self.outliers),
            suspects=self.suspects,
            outliers=self.outliers,
        )


def judge(check: PoseCheck, scene: Scene, keep: Collection[str] = (), exclude: Sequence[str] = ()) -> Verdict:
    """Decide which views to leave out, and what to tell the user.

    Args:
        keep: views that the user wants to stay.
        exclude: what scene.yaml excludes already, to be repeated in the line that the message suggests.
    """
    wrong = [name for name in check.contradicting if name not in keep]
    if not wrong:
        return Verdict()
    if check.is_widespread:
        count = f"at least {len(check.contradicting)} of {check.judged} photographs"
        sentence = f"{count} contradict their poses; do poses and pictures belong together?"
        return Verdict((), tuple(wrong), (sentence,))
    clean = [name for name in wrong if name in scene.clean]
    test = [name for name in wrong if name in scene.test]
    train = [name for name in wrong if name not in {*clean, *test}]
    least = 1 if scene.blank else LEAST_TRAINING_VIEWS
    is_enough = len(scene.train) - len(train) >= least
    fate = "are left out" if is_enough else f"are used all the same, for fewer than {least} would be left"
    cases = (
        (train, "photographs", fate),
        (test, "test photographs", "are scored all the same"),
        (clean, "clean photographs", "are used all the same"),
    )
    sentences = [
        f"{kind} that contradict their poses, or show something else than the others, {fate}: {', '.join(names)}; in "
        f"scene.yaml, {_yaml_line('exclude', exclude, names)} leaves them out for good, "
        f"{_yaml_line('keep', keep, names)} uses them without this warning"
        for names, kind, fate in cases
        if names
    ]
    outliers = tuple(train) if is_enough else ()
    return Verdict(outliers, tuple(name for name in wrong if name not in outliers), tuple(sentences))


def _yaml_line(key: str, named: Collection[str], names: Sequence[str]) -> str:
    """The line of scene.yaml that names these views beside those that it names already."""
    return f"`{key}: {json.dumps(sorted({*named, *names}), ensure_ascii=False)}`"
