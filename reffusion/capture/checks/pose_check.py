"""Finds photographs that contradict their poses: another picture under the same name, a pose that is wrong by degrees.

Where two views see the same sparse points, their pictures must look alike. So the picture of a view is predicted from
its nearest views: the values of their pictures at the points are put where the view's pose projects the points. This
prediction is correlated with the view's own picture at every shift of the picture. A photograph that fits its pose
correlates best without a shift, by a wide margin, whatever its exposure and however few points it shares. A photograph
that does not fit its pose correlates best at some other shift, or at no shift.

Pictures are compared at low resolution; one pixel of the reduced picture is called a *cell*. The compared quantity is
the *detail*, the local contrast of brightness (`_detail`).

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

LONGER_SIDE = 128  # cells along a picture's longer side
WINDOW = 12  # cells: side of the window in which local contrast is computed
NOISE = 4.0  # levels of 255, added to the standard deviation in a window, so that noise gives no detail
POINTS = 5000  # largest number of points that are compared
DENSITY = 12  # mean number of points per square of the visibility test, in which the nearest point hides others
LEAST_SHARED = 50  # visible points that two views must share to be compared
LEAST_POINTS = 250  # points that a view must share with all its neighbors together; fewer correlate by chance
NEIGHBORS = 6  # number of views with which each view is compared
LEAST_NEIGHBORS = 2  # with fewer neighbors, a view is not judged
# cosine of 35 degrees: views whose axes differ by more see different sides of objects, and are not compared
TURN = np.cos(np.radians(35))
LEAST_DETAIL = 0.2  # root mean square of the detail at the points, below which pictures are too plain to compare
SAME, ELSEWHERE = 2, 4  # cells: shifts up to the first count as the pose, shifts above the second as another place
LEAST_MARGIN = 0.1  # by which the correlation at the pose must exceed that at other shifts; right views have 0.2 to 0.7
CLEAR = 0.6  # above this correlation at the pose, a view is wrong only if another shift is better by LEAST_MARGIN
LEAST_OVERLAP = 0.5  # share of the points that must lie in the picture after a shift


@dataclass(frozen=True)
class PoseCheck:
    """The result of `check_poses`.

    Attributes:
        judged: number of views that share enough points with other views to be judged.
        contradicting: sorted names of the views whose photographs contradict their poses.
    """

    judged: int
    contradicting: tuple[str, ...]

    @property
    def is_widespread(self) -> bool:
        """True if at least half of the judged views contradict their poses. Which poses are right is then unknown."""
        return 2 * len(self.contradicting) >= max(self.judged, 1)


def check_poses(cameras: Sequence[Camera], points: np.ndarray, image_of: Callable[[str], np.ndarray]) -> PoseCheck:
    """Find the views whose photographs contradict their poses.

    Each photograph is compared with those of its nearest views at the points that both see. The worst view is set
    aside, and the views that were compared with it are compared again without it. This is repeated until the remaining
    views agree, or half of the judged views are set aside. In the first case each view that was set aside is compared
    with the remaining views once more, and taken back if it agrees with them. The views that are still set aside
    contradict their poses.

    Args:
        cameras: cameras of undistorted views in the normalized frame.
        points: [P, 3], sparse points, or points triangulated from optical flow, in the same frame.
        image_of: function from a view's name to its picture, uint8 [H, W, 3].
    """
    points = points[:: max(1, -(-len(points) // POINTS))]
    cells = max(4, round((len(points) / DENSITY) ** 0.5))
    views = {camera.name: _View.of(camera, points, image_of(camera.name), cells) for camera in cameras}
    order = {name: _nearest(view, views.values()) for name, view in views.items()}
    kept = set(views)
    around = lambda name: [other for other in order[name] if other in kept][:NEIGHBORS]
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
    """The detail of a view's picture, and its values at the points.

    Attributes:
        camera: camera of the view.
        places: [P, 2] int, column and row of the cell that shows each point; valid where `seen`.
        seen: [P] bool, True if the point is visible in the view.
        detail: float32 [h, w], local contrast of the picture in cells, see `_detail`.
        values: float32 [P], the detail at each point; 0 where not `seen`.
    """

    camera: Camera
    places: np.ndarray
    seen: np.ndarray
    detail: np.ndarray
    values: np.ndarray

    @classmethod
    def of(cls, camera: Camera, points: np.ndarray, image: np.ndarray, cells: int) -> _View:
        """Compute the detail of a picture, uint8 [H, W, 3], and its values at points [P, 3].

        Args:
            cells: number of squares along the picture's width in which the nearest point hides others.
        """
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
        """The (rows, columns) of the Fourier transforms: twice the picture, so that shifts do not wrap around."""
        return 2 * self.detail.shape[0], 2 * self.detail.shape[1]

    @cached_property
    def spectra(self) -> list[np.ndarray]:
        """The Fourier transforms of the detail, of its square, and of an array of ones in the size of the picture."""
        pictures = (self.detail, self.detail**2, np.ones_like(self.detail))
        return [np.fft.rfft2(each, self.padded) for each in pictures]

    def distance(self, other: _View) -> float:
        """Return the distance between the centers of two cameras, plus the angle between their axes in radians."""
        cosine = float(self.camera.world_to_camera[2, :3] @ other.camera.world_to_camera[2, :3])
        return float(np.linalg.norm(self.camera.center - other.camera.center) + np.arccos(np.clip(cosine, -1, 1)))


def _detail(image: np.ndarray) -> np.ndarray:
    """Return the local contrast of a picture's brightness, float32 [h, w] in cells, about -1 to 1."""
    gray = to_gray(image)
    factor = LONGER_SIDE / max(gray.shape)
    size = max(1, round(gray.shape[1] * factor)), max(1, round(gray.shape[0] * factor))
    gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    detail = gray - cv2.blur(gray, (WINDOW, WINDOW))
    # does not depend on exposure and shading, and is near 0 where the picture is plain
    return detail / (np.sqrt(np.maximum(cv2.blur(detail**2, (WINDOW, WINDOW)), 0)) + NOISE)


def _nearest(view: _View, others: Collection[_View]) -> list[str]:
    """Return the names of the views that share points and about the same direction with `view`, the nearest first."""
    axis = view.camera.world_to_camera[2, :3]
    others = [each for each in others if each is not view and each.camera.world_to_camera[2, :3] @ axis > TURN]
    shared = [each for each in others if (each.seen & view.seen).sum() >= LEAST_SHARED]
    return [each.camera.name for each in sorted(shared, key=lambda each: (view.distance(each), each.camera.name))]


def _margin(view: _View, others: Sequence[_View]) -> float | None:
    """Return the correlation at a view's pose, plus a bonus if high, minus the best elsewhere; None if unknown."""
    if len(others) < LEAST_NEIGHBORS:
        return None
    count = sum(each.seen & view.seen for each in others)
    known = np.flatnonzero(count)
    # the neighbors' detail at the points predicts that of the view
    expected = sum(np.where(view.seen, each.values, 0) for each in others)[known] / count[known]
    plain = min(np.sqrt(np.mean(each**2)) for each in (expected, view.values[known])) < LEAST_DETAIL
    if len(known) < LEAST_POINTS or plain:
        return None
    correlation, shift = _correlations(view, view.places[known], expected)
    here, elsewhere = correlation[shift <= SAME].max(), correlation[shift > ELSEWHERE].max()
    # Repeating patterns (bricks, tiles) correlate as well after a shift by one period; hence the bonus.
    return float(here - elsewhere + (2 * LEAST_MARGIN if here > CLEAR else 0))


def _correlations(view: _View, places: np.ndarray, expected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the correlation of predicted and seen detail at S shifts, [S], and the lengths of the shifts in cells."""
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


# ---------------------------------------------------------------------------------------------- verdict


@dataclass(frozen=True)
class Verdict:
    """The consequences of a `PoseCheck`: the views to leave out, and the messages to the user.

    Attributes:
        outliers: names of the training views to leave out of the scene, sorted.
        suspects: names of the views that contradict their poses but stay in the scene. These are test views and clean
            views; and training views too, if too few would be left, or if at least half of the judged views contradict.
            Views that `keep` of scene.yaml names are neither outliers nor suspects.
        sentences: messages to the user, which suggest lines of scene.yaml that change the decision.
    """

    outliers: tuple[str, ...] = ()
    suspects: tuple[str, ...] = ()
    sentences: tuple[str, ...] = ()

    def apply(self, scene: Scene) -> Scene:
        """Return the scene without the cameras of the outliers, and with the names of the outliers and suspects."""
        return replace(
            scene,
            cameras={name: camera for name, camera in scene.cameras.items() if name not in self.outliers},
            train=tuple(name for name in scene.train if name not in self.outliers),
            suspects=self.suspects,
            outliers=self.outliers,
        )


def judge(check: PoseCheck, scene: Scene, keep: Collection[str] = (), exclude: Sequence[str] = ()) -> Verdict:
    """Decide which of the contradicting views are left out of the scene, and compose the messages to the user.

    Only training views are left out; none if too few would remain, or if at least half of the judged views contradict.

    Args:
        keep: names of views that scene.yaml keeps in any case; their contradictions are ignored.
        exclude: names of views that scene.yaml excludes already; the suggested line repeats them.
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
    least = 1 if scene.camera_only else LEAST_TRAINING_VIEWS
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
    """Return the line of scene.yaml whose `key` names the views of `named` (its present value) and of `names`."""
    return f"`{key}: {json.dumps(sorted({*named, *names}), ensure_ascii=False)}`"
