"""State of the mask page: the user's marks, the masks computed from the marks, and the files to which both are saved.

A *mark* is a click, a box or a brush stroke in one view, on the object or on the background. A *given* mask is one that
the user put into the scene's folder; the page never changes it. Strokes may also mark pixels that their view ignores.
"""

from __future__ import annotations

import hashlib
import threading
import traceback
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from reffusion.capture.click_coordinates import distort_mask, distort_points, undistort_points
from reffusion.capture.lenses import load_lenses, load_photograph_sizes
from reffusion.capture.mask_files import ALL_VIEWS, IGNORE, NONE
from reffusion.capture.roles import Roles
from reffusion.capture.scene_folder import read_scene
from reffusion.capture.undistort import load_undistorted_mask
from reffusion.clicks.color_evidence import sample_evenly
from reffusion.clicks.events import Event, Masks, group_by_view, split_events
from reffusion.clicks.fitted_views import MAX_NETWORK_VIEWS, FittedViews
from reffusion.clicks.marks import OBJECT, OTHER, SIZES, Mark, confirmed_pixels
from reffusion.clicks.scene_masks import KEPT_VIEWS, load_evidence
from reffusion.clicks.scene_segmentation import (
    SavedMasks,
    correct_own_view,
    segment_first,
    segment_own_view,
    segment_scene,
)
from reffusion.clicks.segmenter import ImageFeatures, Segmenter, encode_image
from reffusion.clicks.single_view import ViewEvidence
from reffusion.command import root
from reffusion.io.arrays import load_json, save_json
from reffusion.io.files import BadInput
from reffusion.io.given_masks import WHITE, load_given_mask
from reffusion.io.images import ENDINGS, replace_image, to_uint8
from reffusion.io.ply import load_ply
from reffusion.io.scene import list_objects, load_raw_masks, load_scene, load_views
from reffusion.params.clicks import CLICKS
from reffusion.params.raw_masks import Params
from reffusion.types import Gaussians
from report import camera_path, sheet

KEPT_RESULTS = 64  # number of intermediate results (masks after some of the marks) that stay in memory


@dataclass(frozen=True)
class Capture:
    """Folders and given masks of the scene that is marked.

    Attributes:
        folder: folder of the scene.
        masks: folder to which the page writes masks, inside `folder` or where the scene keeps its masks.
        poses: folder of the stage `poses`.
        fit: folder of the stage `fit`; may not exist yet.
        given: view -> bool [H, W], True on the object: the masks that the page did not write.
        saved: view -> bool [H, W], the masks that the page wrote, undistorted.
        ignore: view -> file, perhaps missing, with the pixels that only this view ignores; see `find_ignore_files`.
    """

    folder: Path
    masks: Path
    poses: Path
    fit: Path
    given: dict[str, np.ndarray]
    saved: dict[str, np.ndarray] = field(default_factory=dict)
    ignore: dict[str, Path] = field(default_factory=dict)


def load_capture(home: Path) -> Capture:
    """Load folders and given masks of a scene whose stage `raw_masks` has run.

    Args:
        home: runs/<scene> or runs/<scene>@<variant>.

    Raises:
        ValueError: the stage has not run, or masks that the page could write would not suit the scene, because
            scene.yaml has `masks: none`, or the scene's masks distinguish several objects or are not white on black.
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
    written = _saved_marks(folder)["written"]
    own = {name for name, path in files.items() if written.get(_relative_path(path, folder)) == file_digest(path)}
    place = next((path.parent for path in files.values()), folder / (params.mask_folder or "masks"))
    given, lenses = load_raw_masks(raw_masks, [name for name in files if name not in own]), load_lenses(poses)[0]
    saved = {name: load_undistorted_mask(files[name], lenses[name]) for name in sorted(own & lenses.keys())}
    ignore = find_ignore_files(folder, params.ignore, roles)
    return Capture(folder, place, poses, sheet.stage_folder(home, "fit"), given, saved, ignore)


def find_ignore_files(folder: Path, name: str | None, roles: Roles) -> dict[str, Path]:
    """Return training view -> picture of the pixels that only this view ignores, which need not exist.

    Args:
        folder: folder of the scene.
        name: the key `ignore` of scene.yaml.

    Returns:
        The files; {} if the scene ignores nothing by `ignore: none`, or has masks of ignored pixels that are no
        pictures, beside which pictures would not be read or would be second masks.
    """
    files = [path for paths in roles.ignore.values() for path in paths]
    if (name or "").lower() == NONE or any(path.suffix.lower() not in ENDINGS or not path.is_file() for path in files):
        return {}
    own = {view: paths[-1] for view, paths in roles.ignore.items() if paths[-1].stem != ALL_VIEWS}
    return {view: own.get(view, folder / (name or IGNORE) / f"{view}.png") for view in roles.train}


def file_digest(path: Path) -> str:
    """Return a hash of a file's content, as hexadecimal digits."""
    return hashlib.blake2b(path.read_bytes(), digest_size=10).hexdigest()


def _relative_path(path: Path, folder: Path) -> str:
    """Return a path as text, relative to `folder` if it lies inside."""
    return str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path)


def _saved_marks(folder: Path) -> dict:
    """Return the content of clicks.json: "marks", and "written" (path of a mask -> hash of its file)."""
    return load_json(folder / CLICKS) if (folder / CLICKS).is_file() else {"marks": [], "written": {}}


class Superseded(Exception):
    """Exception that stops the computation of masks because the user has changed the marks."""


class Session:
    """The user's marks on a scene, and the masks of its views. All methods may be called from several threads.

    A background thread computes the masks. Until the scene is fitted, a mark changes only the mask of its own view.
    After the fit, marks determine the masks of all views, see `reffusion.clicks.scene_segmentation`. The masks after
    each mark stay in memory, so that adding a mark, or removing the last one, takes little computation. The methods
    that change marks return before the masks are computed; `state` says when the masks are up to date.

    The views are the training views that show the object. The session begins with the marks saved in clicks.json and
    the masks saved with them.

    Args:
        capture: folders and given masks of the scene.
        is_fitted: returns True once the stage `fit` has finished.
        segmenter: network that segments around clicks; None segments by colors and surfaces.
    """

    def __init__(self, capture: Capture, is_fitted: Callable[[], bool], segmenter: Segmenter | None = None):
        self.capture, self.scene = capture, load_scene(capture.poses)
        self.segmenter = segmenter
        # A callback, because the folder of the fit may still contain a fit to earlier poses.
        self.is_fitted = is_fitted
        self.views = [name for name in self.scene.train if name not in self.scene.clean]
        self.lenses, self.sizes = load_lenses(capture.poses)[0], load_photograph_sizes(capture.poses)
        self.images = load_views(capture.poses, self.views)
        cameras = [self.scene.cameras[name] for name in self.views]
        self.first_view = camera_path.find_central_view(cameras, self.scene.points).name if cameras else ""
        self.events: list[Event] = []
        self.history: list[list[Event]] = []  # the marks before each change, for `undo`
        self.masks: Masks = capture.saved | capture.given
        self.solved_masks = self.masks  # the masks before the marks that are not yet solved
        self.versions = dict.fromkeys(self.views, 0)
        self.edition = 0  # grows whenever marks, or files of ignored pixels, change
        self.gaussians: Gaussians | None = None
        self.results: dict[Hashable, Masks] = {}  # keys of `segment_scene` -> masks
        # `revision` grows with each change of the marks. The current masks belong to `solved_revision`.
        self.revision, self.solved_revision = 0, 0
        self.uses: Counter[str] = Counter()  # view -> how often the present computation has used it so far
        self.changes: dict[str, float] = {}  # view -> share of the mask's pixels that the last mark changed
        self.effects: dict[Hashable, float] = {}  # key of a mark -> share of its picture's pixels that it changed
        self.error = ""  # reason why the masks of the latest revision could not be computed
        self.lock = threading.Condition(threading.RLock())
        self.features_of = lru_cache(KEPT_VIEWS)(self._encode)
        self.evidence_of = lru_cache(None)(self._load_evidence)
        for saved in _saved_marks(capture.folder)["marks"]:
            if saved["view"] in self.images and saved["view"] not in capture.given:
                self.events.append(self._from_photograph(saved))
        complete = {*self.views} <= {*self.masks}
        self.settled = SavedMasks(self.events, self.masks) if self.events and complete else None
        # the marks of the saved masks; whether these are the masks of all views
        self.saved = _keys(self.events), complete
        threading.Thread(target=self._update_masks, daemon=True).start()
        if segmenter is not None:
            threading.Thread(target=self._encode_all, daemon=True).start()

    @property
    def unsaved(self) -> bool:
        """Whether marks have changed since the last save, or all views have masks now that were not all saved."""
        with self.lock:
            keys, complete = self.saved
            return keys != _keys(self.events) or bool(keys and not complete and {*self.views} <= {*self.masks})

    def mark(
        self,
        name: str,
        points: Sequence[tuple[float, float]],
        positive: bool,
        radius: float = 0.0,
        ignores: bool = False,
    ) -> None:
        """Add a click, a box or a brush stroke.

        Args:
            name: name of the view.
            points: (x, y) in pixels of the undistorted view; one point of a click, two opposite corners of a box, the
                path of a stroke.
            positive: True = on the object, False = on the background.
            radius: radius of the brush, px; 0 for a click and a box.
            ignores: True for a stroke over pixels that this view ignores (`positive`) or does not ignore.

        Raises:
            ValueError: the view is unknown or has a given mask, there is no point or one lies outside the view, there
                are more than two points without a radius, the radius is negative or larger than the view, or pixels
                are ignored without a radius or in a view that takes no file of them (`Capture.ignore`).
        """
        if name not in self.images:
            raise ValueError(f"there is no view '{name}'")
        if ignores and name not in self.capture.ignore:
            folder = self.capture.folder
            raise ValueError(f"{folder}: `ignore: none` is set, or its masks of ignored pixels are no pictures")
        if name in self.capture.given and not ignores:
            raise ValueError(f"{name} has a mask of your own; move it out of {self.capture.masks} to mark here")
        height, width = self.images[name].shape[:2]
        if not points or any(not (0 <= x <= width and 0 <= y <= height) for x, y in points):
            raise ValueError(f"a mark lies outside {name}, which has {width}x{height} px")
        if ignores and not radius:
            raise ValueError("pixels are ignored below the brush only, and this mark has none")
        if not radius and len(points) > 2:
            raise ValueError(f"a mark of {len(points)} points in {name} has no brush; a click has 1 point, a box has 2")
        if not 0 <= radius <= max(height, width):
            raise ValueError(f"a brush of {radius:g} px on a view of {width}x{height} px")
        event = Event(name, Mark(np.array(points, float), positive, radius), self.gaussians is None, ignores)
        self._change(lambda events: [*events, event])

    def remove(self, index: int) -> None:
        """Remove a mark by its index among all current marks, in the order in which they were made; -1 is the last one.

        The indices of later marks decrease by one.

        Raises:
            IndexError: there is no such mark.
        """
        with self.lock:
            removed = self.events[index]
            self._change(lambda events: [event for event in events if event is not removed])

    def resize(self, index: int, size: str) -> None:
        """Let a click or a box take another one of the proposed regions.

        Args:
            index: index of the mark among all current marks.
            size: as for `Mark.size`.

        Raises:
            IndexError: there is no such mark.
            ValueError: the mark is a stroke, or there is no such size.
        """
        with self.lock:
            event = self.events[index]
            if event.mark.radius or size not in ("", *SIZES):
                raise ValueError(f"size {size!r}: a click or a box has the size {', '.join(SIZES)} or none")
            resized = replace(event, mark=replace(event.mark, size=size))
            self._change(lambda events: [resized if each is event else each for each in events])

    def clear(self, name: str) -> None:
        """Remove all marks of a view."""
        self._change(lambda events: [event for event in events if event.view != name])

    def undo(self) -> str:
        """Take back the last change, also a removal; return a view whose marks have changed, "" if there is none.

        The marks that were saved earlier are taken back one by one.
        """
        with self.lock:
            if not (self.history or self.events):
                return ""
            before, now = self.history.pop() if self.history else self.events[:-1], self.events
            self._replace(before)
            either = [*before, *now]
            changed = [event for event in either if sum(event is each for each in either) == 1]
            return changed[-1].view if changed else ""

    def save(self) -> dict[str, int]:
        """Wait for the masks of the latest marks, then write all masks, the marks to clicks.json, and ignored pixels.

        Masks are written in the pixels of the original, distorted photographs. The masks of an earlier call are
        overwritten, or deleted if the view had marks then and has no mask any more. The files of ignored pixels are
        changed by the strokes, which are then no longer marks: only the eraser takes them back.

        Returns:
            {"written": number of masks written, "kept": number of given masks, which stay as they are, "ignored":
            number of files of ignored pixels that were changed}.

        Raises:
            ValueError: there is nothing to write, the masks could not be computed, a file that the page did not write
                has the name of a mask to write, or a view would be ignored completely.
        """
        with self.lock:
            self.lock.wait_for(lambda: self.solved_revision == self.revision)
            if self.error:
                raise ValueError(self.error)
            masks = {name: mask for name, mask in self.masks.items() if name not in self.capture.given}
            if not any(mask.any() for mask in masks.values()):
                masks = {}
            if not masks and not any(event.ignores for event in self.events):
                raise ValueError("nothing to save yet: click on the object first")
            ignored = self._save_ignored()
            if masks:
                self._save_masks(masks)
            return {"written": len(masks), "kept": len(self.capture.given), "ignored": ignored}

    def _save_masks(self, masks: Masks) -> None:
        """Write masks, and the marks on the object to clicks.json; see `save`."""
        folder, saved = self.capture.folder, _saved_marks(self.capture.folder)
        written = dict(saved["written"])
        paths = {name: self.capture.masks / f"{name}.png" for name in masks}
        foreign = [p for p in paths.values() if p.exists() and written.get(_relative_path(p, folder)) != file_digest(p)]
        if foreign:
            raise ValueError(f"{foreign[0]}: not written by this page, so it is not overwritten; move it away")
        for name, path in paths.items():
            replace_image(path, to_uint8(distort_mask(masks[name], self.lenses[name], self.sizes[name]) * 1.0))
            written[_relative_path(path, folder)] = file_digest(path)
        cleared = {mark["view"] for mark in saved["marks"]}.intersection(self.views) - {*self.masks}
        for path in (self.capture.masks / f"{name}.png" for name in cleared):
            if path.exists() and written.get(_relative_path(path, folder)) == file_digest(path):
                path.unlink()
                del written[_relative_path(path, folder)]
        save_json(folder / CLICKS, {"marks": [self._to_photograph(each) for each in self.events], "written": written})
        self.saved = _keys(self.events), {*self.views} <= {*self.masks}

    def _save_ignored(self) -> int:
        """Change the files of ignored pixels by the strokes, forget the strokes, and return the number of files."""
        views = dict.fromkeys(event.view for event in self.events if event.ignores)
        changed = {name: self.ignored_pixels(name, in_photograph=True) for name in views}
        if whole := [name for name, pixels in changed.items() if pixels.all()]:
            raise ValueError(
                f"all of {whole[0]} would be ignored; erase a part, or leave the view out: `exclude: [{whole[0]}]`"
            )
        for name, pixels in changed.items():
            # An empty picture is written too, because a folder that scene.yaml names must hold pictures.
            replace_image(self.capture.ignore[name], to_uint8(pixels * 1.0))
        if changed:
            self.events, self.history = [event for event in self.events if not event.ignores], []
            self.edition += 1
        return len(changed)

    def ignored_pixels(self, name: str, in_photograph: bool = False) -> np.ndarray:
        """Return which pixels only this view ignores: those of its file, changed by the strokes since the last save.

        Args:
            name: name of a view in `Capture.ignore`.
            in_photograph: True for the pixels of the distorted photograph, False for those of the undistorted view.

        Returns:
            bool [H, W].
        """
        path, lens, size = self.capture.ignore[name], self.lenses[name], self.sizes[name]
        marks = [event.mark for event in self.events if event.ignores and event.view == name]
        signs = confirmed_pixels(marks, (lens.height, lens.width))
        more, less = signs == OBJECT, signs == OTHER
        if in_photograph:
            more, less = (distort_mask(each, lens, size) for each in (more, less))
        if not path.is_file():
            return more
        before = load_given_mask(path, size[::-1]) if in_photograph else load_undistorted_mask(path, lens)
        return before & ~less | more

    def state(self) -> dict:
        """Return the state that the page shows, as plain JSON values.

        Returns:
            "views": for each view "name", "width" and "height" (undistorted, px), "marks", "mask" (a number that grows
            when the mask changes; None without a mask), "given" (True if the mask is given) and "ignored" (a number
            that grows when the ignored pixels change; None without a file or a stroke); "first_view": the view in which
            the object is probably easy to mark; "fit": True once the fit is loaded; "loading": True if there is a fit
            that is not loaded yet; "can_undo": True if there is something to undo; "busy": True while the masks do not
            yet follow the latest marks; "progress": share of this computation that is done; "changes": views whose
            masks the last mark changed, as pairs of name and share of the mask's pixels, the most changed first;
            "error": reason why the masks could not be computed, or ""; "unsaved": as the property; "folder": folder of
            the masks; "network": name of the segmentation network, or "". A mark has "index" (for `remove`), "points",
            "sign" ("+" on the object, "-" on the background), "radius", "size", "ignores" (True if it marks ignored
            pixels instead of the object) and "effect" (share of its picture's pixels that the mark changed; None if
            that is not known).
        """
        with self.lock:
            ignoring = {name for name, path in self.capture.ignore.items() if path.is_file()}
            ignoring |= {event.view for event in self.events if event.ignores}
            views = [
                {
                    "name": name,
                    "width": self.images[name].shape[1],
                    "height": self.images[name].shape[0],
                    "marks": [
                        {
                            "index": k,
                            "points": event.mark.points.tolist(),
                            "sign": "+" if event.mark.positive else "-",
                            "radius": event.mark.radius,
                            "size": event.mark.size,
                            "ignores": event.ignores,
                            "effect": self.effects.get(event.key),
                        }
                        for k, event in enumerate(self.events)
                        if event.view == name
                    ],
                    "mask": self.versions[name] if name in self.masks else None,
                    "given": name in self.capture.given,
                    "ignored": self.edition if name in ignoring else None,
                }
                for name in self.views
            ]
            return {
                "views": views,
                "fit": self.gaussians is not None,
                "loading": self.gaussians is None and self.is_fitted(),
                "can_undo": bool(self.history or self.events),
                "busy": self.solved_revision < self.revision,
                "progress": self._progress(),
                "changes": sorted(self.changes.items(), key=lambda pair: -pair[1]),
                "error": self.error,
                "unsaved": self.unsaved,
                "folder": str(self.capture.masks),
                "network": "" if self.segmenter is None else self.segmenter.name,
                "first_view": self.first_view,
            }

    def _change(self, change: Callable[[list[Event]], list[Event]]) -> None:
        """Replace the marks by `change(marks)`, so that `undo` can take the change back."""
        with self.lock:
            self.history.append(self.events)
            self._replace(change(self.events))

    def _replace(self, events: list[Event]) -> None:
        """Replace the marks, and let the background thread compute the masks anew if those on the object differ."""
        with self.lock:
            if _keys(_on_object(events)) != _keys(_on_object(self.events)):
                self.revision, self.error = self.revision + 1, ""
            self.events, self.edition = events, self.edition + 1
            self.lock.notify_all()

    def _progress(self) -> float:
        """Return the share of the present computation that is done: masks use each view without marks twice."""
        marked = {event.view for event in _on_object(self.events)}
        uses = [min(self.uses[name], 2) / 2 for name in self.views if name not in marked]
        return sum(uses) / max(len(uses), 1)

    def _from_photograph(self, saved: dict) -> Event:
        """Return the mark of an entry of clicks.json, whose points are pixels of the distorted photograph."""
        name = saved["view"]
        points = undistort_points(np.array(saved["points"], float).reshape(-1, 2), self.lenses[name], self.sizes[name])
        mark = Mark(points, saved["sign"] == "+", saved["radius"] / self._photograph_scale(name), saved.get("size", ""))
        return Event(name, mark, saved.get("early", False))

    def _to_photograph(self, event: Event) -> dict:
        """Return a mark's entry for clicks.json, the inverse of `_from_photograph`."""
        name, mark = event.view, event.mark
        points = distort_points(mark.points, self.lenses[name], self.sizes[name]).round(1).tolist()
        radius = round(mark.radius * self._photograph_scale(name), 2)
        place = {"view": name, "points": points, "sign": "+" if mark.positive else "-", "radius": radius}
        return place | {"size": mark.size, "early": event.is_early}

    def _photograph_scale(self, name: str) -> float:
        """Return the scale of a view: the number of pixels of the photograph per pixel of the undistorted view."""
        return self.sizes[name][0] / self.lenses[name].width

    def _encode(self, name: str) -> ImageFeatures:
        """Return the features of a view for the segmentation network, which must exist."""
        assert self.segmenter is not None
        return encode_image(self.segmenter, self.images[name])

    def _encode_all(self) -> None:
        """Encode the views for the segmentation network in a background thread, before the user marks any."""
        # This runs while the scene is being fitted.
        for name in sample_evenly(sorted(self.views), MAX_NETWORK_VIEWS):
            self.features_of(name)

    def _load_evidence(self, name: str) -> ViewEvidence:
        """Return what the segmentation of a view uses: colors, features and, after the fit, surfaces."""
        features_of = lambda: self.features_of(name)
        return load_evidence(self.images[name], self.gaussians, self.scene.cameras[name], self.segmenter, features_of)

    def _update_masks(self) -> None:
        """Compute the masks whenever marks change, and once when the scene is fitted; runs in a background thread."""
        while True:
            with self.lock:
                self.lock.wait_for(lambda: self.solved_revision < self.revision, None if self.gaussians else 1.0)
                revision, events = self.revision, _on_object(self.events)
            if self.gaussians is None and self.is_fitted():
                self._load_fit()
                continue
            if self.solved_revision == revision:
                continue
            try:
                self._solve(events, revision)
                error = ""
            except Superseded:
                continue
            except Exception as failure:  # the thread must not end; the page shows the reason
                traceback.print_exc()
                error = f"no masks: {failure}"
            with self.lock:
                if revision == self.revision:
                    self.changes, self.solved_masks = _compare_masks(self.solved_masks, self.masks), self.masks
                    self.solved_revision, self.error = revision, error
                    self.lock.notify_all()

    def _load_fit(self) -> None:
        """Load the fitted Gaussians, forget results from before the fit, and let the masks be computed anew."""
        gaussians = load_ply(self.capture.fit / "gaussians.ply")
        with self.lock:
            self.gaussians = gaussians
            self.evidence_of.cache_clear()  # evidence from before the fit has no surfaces
            self.results.clear()
            self.revision += bool(_on_object(self.events))

    def _solve(self, events: list[Event], revision: int) -> None:
        """Compute the masks from the marks and show them; raises Superseded if the user changes the marks meanwhile."""

        def evidence_of(name: str) -> ViewEvidence:
            if revision != self.revision:
                raise Superseded
            self.uses[name] += 1
            return self.evidence_of(name)

        def note_effect(before: Masks, after: Masks) -> None:
            view = events[-1].view
            empty = np.zeros(self.images[view].shape[:2], bool)
            self.effects[events[-1].key] = float((before.get(view, empty) ^ after.get(view, empty)).mean())

        self.uses = Counter()
        given, masks = self.capture.given, dict(self.capture.given)
        if self.gaussians is None:
            for name in dict.fromkeys(event.view for event in events):
                own = [event for event in events if event.view == name]
                masks |= segment_own_view(evidence_of, own, self._recall)
                if own[-1] is events[-1]:
                    note_effect(segment_own_view(evidence_of, own[:-1], self._recall) if own[:-1] else {}, masks)
        elif events:
            cameras = {name: self.scene.cameras[name] for name in {*self.views, *given}}
            views = FittedViews(self.gaussians, cameras, evidence_of)
            settled = self._settled_part(events)
            first, groups = split_events(events, given)  # each marked view is shown before all views follow
            if settled is not None:
                first, groups = {"": [*settled.events]}, group_by_view(events[len(settled.events) :])
            elif not groups:
                masks |= segment_first(evidence_of, first, self._recall)
                own = first.get(events[-1].view, [])[:-1]
                note_effect(segment_own_view(evidence_of, own, self._recall) if own else {}, masks)
                self._show({**self.masks, **masks}, revision)
            if groups:
                count = len(groups[-1])
                in_order = [event for group in (*first.values(), *groups) for event in group]
                masks = segment_scene(views, in_order[:-count], given, self._recall, settled)
                corrected = correct_own_view(views, in_order, count, masks, self._recall)
                if in_order[-1] is events[-1]:
                    previous = in_order[:-1], count - 1, masks, self._recall
                    note_effect(correct_own_view(views, *previous) if count > 1 else masks, corrected)
                self._show({**masks, **corrected}, revision)
            masks = segment_scene(views, events, given, self._recall, settled)
        self._show(masks, revision)

    def _settled_part(self, events: Sequence[Event]) -> SavedMasks | None:
        """Return the saved masks if the marks of these are the first of `events`, else None."""
        settled = self.settled
        if settled is None or [event.key for event in settled.events] != [e.key for e in events[: len(settled.events)]]:
            return None
        return settled

    def _recall(self, key: Hashable, compute: Callable[[], Masks]) -> Masks:
        """Return the remembered result for a key, or call `compute` and remember its result."""
        if key not in self.results:
            self.results[key] = compute()
            while len(self.results) > KEPT_RESULTS:
                del self.results[next(iter(self.results))]
        return self.results[key]

    def _show(self, masks: Masks, revision: int) -> None:
        """Replace the shown masks; raises Superseded if they do not belong to the latest revision of the marks."""
        with self.lock:
            if revision != self.revision:
                raise Superseded
            for name in self.views:
                if masks.get(name) is not self.masks.get(name):
                    self.versions[name] += 1
            self.masks = dict(masks)


def _keys(events: Sequence[Event]) -> list[Hashable]:
    """Return a key for each mark, in order; equal keys mean equal marks."""
    return [event.key for event in events]


def _on_object(events: Sequence[Event]) -> list[Event]:
    """Return the marks on the object or the background, without the strokes over ignored pixels."""
    return [event for event in events if not event.ignores]


def _compare_masks(before: Masks, after: Masks) -> dict[str, float]:
    """Return view -> share of the larger mask's pixels that differ, for the views in which pixels differ."""
    shares = {}
    for name in before.keys() & after.keys():
        if changed := int((before[name] ^ after[name]).sum()):
            shares[name] = changed / max(int(before[name].sum()), int(after[name].sum()))
    return shares
