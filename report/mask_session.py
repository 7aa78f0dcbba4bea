"""State behind the mask page: the clicks, the masks that follow from them, and the files they are saved to."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from torch import Tensor

from reffusion.capture.click_coordinates import distort_mask, distort_points, undistort_points
from reffusion.capture.lenses import load_lenses, load_photograph_sizes
from reffusion.capture.scene_folder import read_scene
from reffusion.clicks import all_views
from reffusion.clicks.marks import Clicks
from reffusion.clicks.network import SOURCE, ImageFeatures, Segmenter, encode_image, load_segmenter, predict_mask
from reffusion.clicks.single_view import correct_mask, segment_view
from reffusion.command import root
from reffusion.io.arrays import load_json, save_json
from reffusion.io.files import BadInput
from reffusion.io.images import WHITE, replace_image, to_uint8
from reffusion.io.ply import load_ply
from reffusion.io.scene import list_objects, load_raw_masks, load_scene, load_views
from reffusion.params.clicks import CLICKS
from reffusion.params.raw_masks import Params
from report import sheet


@dataclass(frozen=True)
class Capture:
    """What the page knows of a scene.

    Attributes:
        folder: of the scene; masks: its folder of masks.
        poses: artifact of the stage `poses`; fit: where the artifact of `fit` is, or will be.
        given: view -> bool [H, W], masks that the page did not write.
    """

    folder: Path
    masks: Path
    poses: Path
    fit: Path
    given: dict[str, np.ndarray]


def load_capture(home: Path) -> Capture:
    """Load runs/<scene>, after its stage `raw_masks`.

    Raises:
        ValueError: the stage has not run, or scene.yaml leaves the page no place to write masks to.
    """
    poses, raw_masks = (sheet.stage_folder(home, stage) for stage in ("poses", "raw_masks"))
    if not (raw_masks / "receipt.json").is_file():
        raise ValueError(f"{raw_masks} is missing; run `make scene={home.name.split('@')[0]} mask`")
    folder = root() / (poses.parent / "source").read_text(encoding="utf-8").strip()
    params = Params(**load_json(raw_masks / "receipt.json")["params"])
    if not params.has_masks:
        raise BadInput(f"{folder / 'scene.yaml'}: `masks: none` is set; remove that line to make masks")
    if list_objects(raw_masks):
        raise BadInput(f"{raw_masks / 'masks'}: the masks distinguish several objects, which clicks cannot")
    roles = read_scene(params.changed({"clicks": {}}), folder)[1]
    if roles.values != WHITE:
        raise BadInput(f"{folder}: its masks hold object numbers or are inverted; remove them: clicks write white ones")
    files = roles.masks.get("", {})
    written = _saved_clicks(folder)["written"]
    foreign = [name for name, path in files.items() if written.get(_relative_path(path, folder)) != file_digest(path)]
    place = next((path.parent for path in files.values()), folder / (params.mask_folder or "masks"))
    return Capture(folder, place, poses, sheet.stage_folder(home, "fit"), load_raw_masks(raw_masks, foreign))


def load_local_segmenter() -> Segmenter | None:
    """The segmentation network whose weights are on this machine, or None. ValueError if the weights are incomplete."""
    if (segmenter := load_segmenter()) is not None:
        print(f"clicks are segmented by {SOURCE}", flush=True)
    return segmenter


def file_digest(path: Path) -> str:
    """Hash of a file's content."""
    return hashlib.blake2b(path.read_bytes(), digest_size=10).hexdigest()


def _relative_path(path: Path, folder: Path) -> str:
    return str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path)


def _saved_clicks(folder: Path) -> dict:
    return load_json(folder / CLICKS) if (folder / CLICKS).is_file() else {"clicks": {}, "written": {}}


class Session:
    """The clicks on a scene. Safe to call from several threads.

    A click makes the mask of its view at once, by the segmentation network if there is one. Once the scene is fitted, a
    background thread labels Gaussians from all clicks and makes the masks of all views.
    """

    def __init__(self, capture: Capture, fitted: Callable[[], bool], segmenter: Segmenter | None = None):
        self.capture, self.scene = capture, load_scene(capture.poses)
        self.segmenter, self.unsaved = segmenter, False
        self.embeddings: dict[str, ImageFeatures] = {}  # view that was clicked on -> the network's features
        self.fitted = fitted  # is the fit of these poses finished? the folder may still hold a fit of earlier poses
        self.views = [name for name in self.scene.train if name not in self.scene.clean]
        self.lenses, self.sizes = load_lenses(capture.poses)[0], load_photograph_sizes(capture.poses)
        self.images = load_views(capture.poses, self.views)
        self.clicks: dict[str, list[tuple[float, float, bool]]] = {}
        self.masks, self.versions = dict(capture.given), dict.fromkeys(self.views, 0)
        self.gaussians: all_views.Gaussians | None = None
        self.near: all_views.NeighbourGraph | None = None
        self.labels: Tensor | None = None
        self.pending_views: list[str] = []  # views whose masks do not follow the latest labels yet
        self.reliefs: dict[str, np.ndarray] = {}
        self.revision, self.solved_revision = 0, 0  # of the clicks, and of the clicks that the labels include
        self.lock, self.changed = threading.RLock(), threading.Event()
        for name, points in _saved_clicks(capture.folder)["clicks"].items():
            if name in self.views:
                at = undistort_points(np.array([p[:2] for p in points]), self.lenses[name], self.sizes[name])
                self.clicks[name] = [(*xy, p[2] == "+") for xy, p in zip(at.tolist(), points, strict=True)]
        threading.Thread(target=self._update_masks, daemon=True).start()
        for name in self.clicks:
            self._set_mask(name, self._single_view_mask(name))

    def click(self, name: str, points: list[tuple[float, float, bool]]) -> None:
        """Replace all clicks on a view; points are in its undistorted pixels.

        Raises:
            ValueError: the view is unknown, has a mask of its own, or a click lies outside it.
        """
        if name not in self.images:
            raise ValueError(f"there is no view '{name}'")
        if name in self.capture.given:
            raise ValueError(f"{name} has a mask of your own; move it out of {self.capture.masks} to click here")
        height, width = self.images[name].shape[:2]
        if any(not (0 <= x <= width and 0 <= y <= height) for x, y, _ in points):
            raise ValueError(f"a click lies outside {name}, which has {width}x{height} px")
        with self.lock:
            self.unsaved = True
            self.clicks[name] = points
            if not points:
                del self.clicks[name]
            if points or self.gaussians is None:
                self._set_mask(name, self._single_view_mask(name))
            self.revision += 1
            self.changed.set()

    def save(self) -> dict[str, int]:
        """Write masks and clicks.json; return how many masks were "written" and how many of the user's were "kept".

        Raises:
            ValueError: there is no mask to write, or a file that the page did not write is in the way.
        """
        with self.lock:
            masks = {name: mask for name, mask in self.masks.items() if name not in self.capture.given}
            if not any(mask.any() for mask in masks.values()):
                raise ValueError("nothing to save yet: click on the object first")
            if self.gaussians is not None and self.solved_revision < self.revision:
                self._apply_labels(self._solver()(), self.revision)
            for name in list(self.pending_views):
                self._refine(name)
            masks = {name: mask for name, mask in self.masks.items() if name not in self.capture.given}
            folder, written = self.capture.folder, dict(_saved_clicks(self.capture.folder)["written"])
            paths = {name: self.capture.masks / f"{name}.png" for name in masks}
            foreign = [
                p for p in paths.values() if p.exists() and written.get(_relative_path(p, folder)) != file_digest(p)
            ]
            if foreign:
                raise ValueError(f"{foreign[0]}: not written by this page, so it is not overwritten; move it away")
            for name, path in paths.items():
                replace_image(path, to_uint8(distort_mask(masks[name], self.lenses[name], self.sizes[name]) * 1.0))
                written[_relative_path(path, folder)] = file_digest(path)
            save_json(folder / CLICKS, {"clicks": self._photograph_clicks(), "written": written})
            self.unsaved = False
            return {"written": len(masks), "kept": len(self.capture.given)}

    def state(self) -> dict:
        """What the page shows, as plain JSON values."""
        with self.lock:
            views = [
                {
                    "name": name,
                    "width": self.images[name].shape[1],
                    "height": self.images[name].shape[0],
                    "clicks": [[x, y, "+" if positive else "-"] for x, y, positive in self.clicks.get(name, [])],
                    "mask": self.versions[name] if name in self.masks else None,
                    "given": name in self.capture.given,
                }
                for name in self.views
            ]
            return {
                "views": views,
                "fit": self.gaussians is not None,
                "busy": len(self.pending_views)
                or int(self.gaussians is not None and self.solved_revision < self.revision),
                "unsaved": self.unsaved,
                "folder": str(self.capture.masks),
            }

    def _photograph_clicks(self) -> dict[str, list]:
        """The clicks in pixels of the distorted photographs."""
        clicks = {}
        for name, points in self.clicks.items():
            at = distort_points(np.array([p[:2] for p in points]), self.lenses[name], self.sizes[name]).round(1)
            clicks[name] = [[*xy, "+" if p[2] else "-"] for xy, p in zip(at.tolist(), points, strict=True)]
        return clicks

    def _clicks_on(self, name: str) -> Clicks | None:
        points = self.clicks.get(name)
        if not points:
            return None
        return Clicks(np.array([p[:2] for p in points], float), np.array([p[2] for p in points], bool))

    def _set_mask(self, name: str, mask: np.ndarray | None) -> None:
        if mask is None:
            self.masks.pop(name, None)
        else:
            self.masks[name] = mask
        self.versions[name] += 1

    def _single_view_mask(self, name: str) -> np.ndarray | None:
        """Mask of a view from its own clicks, before the Gaussians are labelled; None without clicks."""
        clicks, image, relief = self._clicks_on(name), self.images[name], None
        if clicks is None:
            return None
        if self._uses_network(clicks):
            return self._network_mask(name, clicks)
        if self.gaussians is not None:
            if name not in self.reliefs:
                self.reliefs[name] = all_views.surface_relief(self.gaussians, self.scene.cameras[name])
            relief = self.reliefs[name]
        alone = not self.capture.given and all_views.order_views(self._all_clicks())[0] == name
        if alone or name not in self.masks:
            return segment_view(image, clicks, relief)
        return correct_mask(image, self.masks[name], clicks, relief)

    def _uses_network(self, clicks: Clicks) -> bool:
        """True if the network answers these clicks.

        Negative clicks alone correct a mask that follows from other views, of which the network knows nothing.
        """
        return self.segmenter is not None and bool(clicks.positive.any())

    def _network_mask(self, name: str, clicks: Clicks) -> np.ndarray:
        assert self.segmenter is not None  # `_uses_network`
        if name not in self.embeddings:
            self.embeddings[name] = encode_image(self.segmenter, self.images[name])
        return predict_mask(self.segmenter, self.embeddings[name], clicks)

    def _all_clicks(self) -> dict[str, Clicks]:
        return {name: on for name in self.clicks if (on := self._clicks_on(name)) is not None}

    def _solver(self) -> Callable[[], Tensor | None]:
        """Function that labels the object from all present clicks, bool [N]; it returns None if nothing marks it."""
        clicks, masks = self._all_clicks(), self.capture.given
        if not any(each.positive.any() for each in clicks.values()) and not masks:
            return lambda: None
        by_network = [name for name, on in clicks.items() if self._uses_network(on)]
        masks = masks | {name: self._network_mask(name, clicks.pop(name)) for name in by_network}
        cameras = {name: self.scene.cameras[name] for name in {*self.views, *masks}}
        assert self.gaussians is not None and self.near is not None
        problem = (self.gaussians, self.near, cameras, self.images.__getitem__, clicks, masks)
        return lambda: all_views.segment_by_clicks(*problem).labels

    def _apply_labels(self, labels: Tensor | None, revision: int) -> None:
        """Show the labels that include the clicks up to `revision`; views with clicks are updated first."""
        self.labels, self.solved_revision = labels, revision
        if labels is None:
            self.pending_views = []
            for name in self.views:
                self._set_mask(name, None)
            return
        for name in self.clicks:
            self._refine(name)
        self.pending_views = [name for name in self.views if name not in self.clicks and name not in self.capture.given]

    def _refine(self, name: str) -> None:
        assert self.gaussians is not None and self.labels is not None
        camera, image, on = self.scene.cameras[name], self.images[name], self._clicks_on(name)
        self._set_mask(name, all_views.object_mask(self.gaussians, self.labels, camera, image, on))
        self.pending_views = [each for each in self.pending_views if each != name]

    def _update_masks(self) -> None:
        """Background thread: wait for the fit, then remake the masks of all views whenever clicks change."""
        while True:
            if self.gaussians is None:
                self.changed.wait(1.0)
                self.changed.clear()
                self._load_fit()
            elif self.solved_revision < self.revision:
                with self.lock:
                    revision, solve = self.revision, self._solver()
                labels = solve()
                with self.lock:
                    if revision == self.revision > self.solved_revision:
                        self._apply_labels(labels, revision)
            elif not self.pending_views:
                self.changed.wait()
                self.changed.clear()
            else:
                with self.lock:
                    if self.pending_views and self.solved_revision == self.revision:
                        self._refine(self.pending_views[0])

    def _load_fit(self) -> None:
        if self.fitted():
            gaussians = load_ply(self.capture.fit / "gaussians.ply")
            near = all_views.find_neighbours(gaussians)
            with self.lock:
                self.gaussians, self.near = gaussians, near
                self.revision += bool(self.clicks)
