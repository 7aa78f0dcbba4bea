"""What the mask page does between its requests: clicks, the masks they make, and the files that these are saved to."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from torch import Tensor

from reffusion.capture.click_coordinates import as_photographed, photographed, straightened
from reffusion.capture.lenses import load_lenses, photograph_sizes
from reffusion.capture.scene_folder import read_scene
from reffusion.clicks import all_views
from reffusion.clicks.marks import Clicks
from reffusion.clicks.network import SOURCE, Looked, Segmenter, load_segmenter, look, network_mask
from reffusion.clicks.single_view import corrected, view_mask
from reffusion.command import root
from reffusion.io.arrays import load_json, save_json
from reffusion.io.files import BadInput
from reffusion.io.images import WHITE, replace_image, to_uint8
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_raw_masks, load_scene, load_views, objects_of
from reffusion.params.clicks import CLICKS
from reffusion.params.raw_masks import Params
from report import sheet


@dataclass(frozen=True)
class Capture:
    """What the page knows of a scene.

    Attributes:
        folder: of the scene; masks: its folder of masks.
        poses: the stage's artifact; fit: where that of `fit` is, or will be.
        given: view -> bool [H, W], masks that the page did not write.
    """

    folder: Path
    masks: Path
    poses: Path
    fit: Path
    given: dict[str, np.ndarray]


def load_capture(home: Path) -> Capture:
    """Of runs/<scene>, after its stage `raw_masks`.

    Raises:
        ValueError: it has not run; the scene's own words leave the page no place to write to.
    """
    poses, raw_masks = (sheet.stage_folder(home, stage) for stage in ("poses", "raw_masks"))
    if not (raw_masks / "receipt.json").is_file():
        raise ValueError(f"{raw_masks}: not there; run `make scene={home.name.split('@')[0]} mask`")
    folder = root() / (poses.parent / "source").read_text(encoding="utf-8").strip()
    params = Params(**load_json(raw_masks / "receipt.json")["params"])
    if not params.has_masks:
        raise BadInput(f"{folder / 'scene.yaml'}: it says `masks: none`; remove that line to make masks")
    if objects_of(raw_masks):
        raise BadInput(f"{raw_masks / 'masks'}: the masks tell objects apart, which clicks do not")
    roles = read_scene(params.changed({"clicks": {}}), folder)[1]
    if roles.values != WHITE:
        raise BadInput(f"{folder}: its masks hold object numbers, or are inverted; remove them: clicks make white ones")
    files = roles.masks.get("", {})
    written = _saved(folder)["written"]
    theirs = [name for name, path in files.items() if written.get(_named(path, folder)) != file_digest(path)]
    place = next((path.parent for path in files.values()), folder / (params.mask_folder or "masks"))
    return Capture(folder, place, poses, sheet.stage_folder(home, "fit"), load_raw_masks(raw_masks, theirs))


def load_local_segmenter() -> Segmenter | None:
    """The segmentation network whose weights are on this machine. ValueError where they are not whole."""
    if (found := load_segmenter()) is not None:
        print(f"clicks are answered by {SOURCE}", flush=True)
    return found


def file_digest(path: Path) -> str:
    """Of a file's content."""
    return hashlib.blake2b(path.read_bytes(), digest_size=10).hexdigest()


def _named(path: Path, folder: Path) -> str:
    return str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path)


def _saved(folder: Path) -> dict:
    return load_json(folder / CLICKS) if (folder / CLICKS).is_file() else {"clicks": {}, "written": {}}


class Session:
    """The clicks on a scene; safe to call from several threads.

    Masks are made for a view at once, by a segmentation network where there is one. Where the fit is there, a thread of
    its own then asks the Gaussians, and makes those of all views.
    """

    def __init__(self, capture: Capture, fitted: Callable[[], bool], segmenter: Segmenter | None = None):
        self.capture, self.scene = capture, load_scene(capture.poses)
        self.segmenter, self.unsaved = segmenter, False
        self.looked: dict[str, Looked] = {}  # what the network made of the views that were clicked on
        self.fitted = fitted  # is the fit there that belongs to these poses? one of earlier poses may be, in its place
        self.views = [name for name in self.scene.train if name not in self.scene.clean]
        self.lenses, self.sizes = load_lenses(capture.poses)[0], photograph_sizes(capture.poses)
        self.images = load_views(capture.poses, self.views)
        self.clicks: dict[str, list[tuple[float, float, bool]]] = {}
        self.masks, self.versions = dict(capture.given), dict.fromkeys(self.views, 0)
        self.gaussians = self.near = self.labels = None
        self.todo: list[str] = []  # views whose masks are not yet those of the latest labels
        self.reliefs: dict[str, np.ndarray] = {}
        self.made, self.solved = 0, 0  # how often clicks changed, and up to which change they are in the labels
        self.turn, self.asked = threading.RLock(), threading.Event()
        for name, points in _saved(capture.folder)["clicks"].items():
            if name in self.views:
                at = straightened(np.array([p[:2] for p in points]), self.lenses[name], self.sizes[name])
                self.clicks[name] = [(*xy, p[2] == "+") for xy, p in zip(at.tolist(), points, strict=True)]
        threading.Thread(target=self._follow, daemon=True).start()
        for name in self.clicks:
            self._show(name, self._at_once(name))

    def click(self, name: str, points: list[tuple[float, float, bool]]) -> None:
        """All clicks on a view, in its undistorted pixels, in place of those before.

        Raises:
            ValueError: the view is unknown, has a mask of its own, or a click lies beside it.
        """
        if name not in self.images:
            raise ValueError(f"there is no view '{name}'")
        if name in self.capture.given:
            raise ValueError(f"{name} has a mask that you brought; move it out of {self.capture.masks} to click here")
        height, width = self.images[name].shape[:2]
        if any(not (0 <= x <= width and 0 <= y <= height) for x, y, _ in points):
            raise ValueError(f"a click lies beside {name}, which has {width}x{height} px")
        with self.turn:
            self.unsaved = True
            self.clicks[name] = points
            if not points:
                del self.clicks[name]
            if points or self.gaussians is None:
                self._show(name, self._at_once(name))
            self.made += 1
            self.asked.set()

    def save(self) -> dict[str, int]:
        """Write masks and clicks.json; how many masks were "written", and "kept" because the page did not write them.

        Raises:
            ValueError: there is no mask to write, or a file of another's is in the way.
        """
        with self.turn:
            masks = {name: mask for name, mask in self.masks.items() if name not in self.capture.given}
            if not any(mask.any() for mask in masks.values()):
                raise ValueError("nothing to save yet: click on the object first")
            if self.gaussians is not None and self.solved < self.made:
                self._take(self._solver()(), self.made)
            for name in list(self.todo):
                self._refine(name)
            masks = {name: mask for name, mask in self.masks.items() if name not in self.capture.given}
            folder, written = self.capture.folder, dict(_saved(self.capture.folder)["written"])
            paths = {name: self.capture.masks / f"{name}.png" for name in masks}
            foreign = [p for p in paths.values() if p.exists() and written.get(_named(p, folder)) != file_digest(p)]
            if foreign:
                raise ValueError(f"{foreign[0]}: not written by this page, and not overwritten; move it away")
            for name, path in paths.items():
                replace_image(path, to_uint8(as_photographed(masks[name], self.lenses[name], self.sizes[name]) * 1.0))
                written[_named(path, folder)] = file_digest(path)
            save_json(folder / CLICKS, {"clicks": self._photographed(), "written": written})
            self.unsaved = False
            return {"written": len(masks), "kept": len(self.capture.given)}

    def state(self) -> dict:
        """What the page shows, as JSON takes it."""
        with self.turn:
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
                "busy": len(self.todo) or int(self.gaussians is not None and self.solved < self.made),
                "unsaved": self.unsaved,
                "folder": str(self.capture.masks),
            }

    def _photographed(self) -> dict[str, list]:
        """The clicks in pixels of the photographs."""
        said = {}
        for name, points in self.clicks.items():
            at = photographed(np.array([p[:2] for p in points]), self.lenses[name], self.sizes[name]).round(1)
            said[name] = [[*xy, "+" if p[2] else "-"] for xy, p in zip(at.tolist(), points, strict=True)]
        return said

    def _clicks_on(self, name: str) -> Clicks | None:
        points = self.clicks.get(name)
        return points and Clicks(np.array([p[:2] for p in points], float), np.array([p[2] for p in points], bool))

    def _show(self, name: str, mask: np.ndarray | None) -> None:
        if mask is None:
            self.masks.pop(name, None)
        else:
            self.masks[name] = mask
        self.versions[name] += 1

    def _at_once(self, name: str) -> np.ndarray | None:
        """A view's mask by the clicks on it, before the Gaussians are asked."""
        clicks, image, relief = self._clicks_on(name), self.images[name], None
        if clicks is None:
            return None
        if self._asks_network(clicks):
            return self._by_network(name, clicks)
        if self.gaussians is not None:
            if name not in self.reliefs:
                self.reliefs[name] = all_views.relief(self.gaussians, self.scene.cameras[name])
            relief = self.reliefs[name]
        alone = not self.capture.given and all_views.in_order(self._all_clicks())[0] == name
        if alone or name not in self.masks:
            return view_mask(image, clicks, relief)
        return corrected(image, self.masks[name], clicks, relief)

    def _asks_network(self, clicks: Clicks) -> bool:
        """It knows nothing of what is taken back in one view from the mask of others."""
        return self.segmenter is not None and bool(clicks.positive.any())

    def _by_network(self, name: str, clicks: Clicks) -> np.ndarray:
        if name not in self.looked:
            self.looked[name] = look(self.segmenter, self.images[name])
        return network_mask(self.segmenter, self.looked[name], clicks)

    def _all_clicks(self) -> dict[str, Clicks]:
        return {name: self._clicks_on(name) for name in self.clicks}

    def _solver(self) -> Callable[[], Tensor | None]:
        """What finds the object by all clicks there are now, bool [N]; None where nothing says what it is."""
        clicks, given = self._all_clicks(), self.capture.given
        if not any(each.positive.any() for each in clicks.values()) and not given:
            return lambda: None
        asked = [name for name, on in clicks.items() if self._asks_network(on)]
        given = given | {name: self._by_network(name, clicks.pop(name)) for name in asked}
        shown = {name: self.scene.cameras[name] for name in {*self.views, *given}}
        ask = (self.gaussians, self.near, shown, self.images.__getitem__, clicks, given)
        return lambda: all_views.solved(*ask).labels

    def _take(self, labels: Tensor | None, made: int) -> None:
        """Show the labels that follow from so many changes of clicks: those views first that were clicked on."""
        self.labels, self.solved = labels, made
        if labels is None:
            self.todo = []
            for name in self.views:
                self._show(name, None)
            return
        for name in self.clicks:
            self._refine(name)
        self.todo = [name for name in self.views if name not in self.clicks and name not in self.capture.given]

    def _refine(self, name: str) -> None:
        camera, image, on = self.scene.cameras[name], self.images[name], self._clicks_on(name)
        self._show(name, all_views.shown(self.gaussians, self.labels, camera, image, on))
        self.todo = [each for each in self.todo if each != name]

    def _follow(self) -> None:
        """Wait for the fit; then make the masks of all views, whenever clicks changed."""
        while True:
            if self.gaussians is None:
                self.asked.wait(1.0)
                self.asked.clear()
                self._load()
            elif self.solved < self.made:
                with self.turn:
                    made, solve = self.made, self._solver()
                labels = solve()
                with self.turn:
                    if made == self.made > self.solved:
                        self._take(labels, made)
            elif not self.todo:
                self.asked.wait()
                self.asked.clear()
            else:
                with self.turn:
                    if self.todo and self.solved == self.made:
                        self._refine(self.todo[0])

    def _load(self) -> None:
        if self.fitted():
            gaussians = load_ply(self.capture.fit / "gaussians.ply")
            near = all_views.neighbours(gaussians)
            with self.turn:
                self.gaussians, self.near = gaussians, near
                self.made += bool(self.clicks)
