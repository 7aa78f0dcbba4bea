"""Scenes that the page shows: where they are, which pictures they have, and which of them are recent."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from reffusion.capture.load import detect_layout, load_capture
from reffusion.command import root, scene_name, scene_path, workplace
from reffusion.io.arrays import load_json
from reffusion.io.files import VIDEOS
from reffusion.io.images import ENDINGS
from report.app.mask_step import MaskStep
from runner.frames import FRAMES

MAX_RECENT = 12


@dataclass
class OpenScene:
    """A scene that the page shows.

    Attributes:
        name: name of the scene.
        source: folder or video that the user named.
        home: runs/<scene>.
        mask_step: marks and masks; None before the user marks the object.
    """

    name: str
    source: Path
    home: Path
    mask_step: MaskStep | None = field(default=None)

    @property
    def folder(self) -> Path:
        """The folder of the photographs; of a video, that of its frames."""
        return self.home / FRAMES if self.source.suffix.lower() in VIDEOS and not self.source.is_dir() else self.source

    def pictures(self) -> dict[str, Path]:
        """Return view name -> photograph: undistorted once `poses` has run, else as captured; {} without a folder.

        Raises:
            ValueError: the folder is no capture.
        """
        placed = self.home / "poses"
        if (placed / "receipt.json").is_file():
            return {path.stem: path for path in sorted((placed / "images").glob("*.png"))}
        return _captured(self.folder, self.folder.stat().st_mtime_ns) if self.folder.is_dir() else {}

    def views(self) -> dict[str, list[str]]:
        """Return views.json of the stage `poses`, role -> names of views; empty before this stage."""
        path = self.home / "poses" / "views.json"
        return load_json(path) if path.is_file() else {}


@lru_cache(8)
def _captured(folder: Path, changed: int) -> dict[str, Path]:
    """Return the pictures of a capture; `changed` is the folder's time of change, by which the result is cached."""
    return dict(sorted(load_capture(folder).pictures.items()))


def find_scene(text: str, runs: Path) -> OpenScene:
    """Return the scene that a name or a path means, also a finished scene whose folder or video is no longer there.

    Raises:
        ValueError: there is no such scene, or a file that is no video, or a folder without photographs.
    """
    source = scene_path(text.strip(), root()) or _find_lost(text.strip(), runs)
    if source is None:
        raise ValueError(f"there is no folder or video at {text.strip() or 'an empty path'}")
    if not source.exists():
        return OpenScene(_name(source), source, runs / _name(source))
    if source.is_file() and source.suffix.lower() not in VIDEOS:
        raise ValueError(f"{source}: neither a folder nor a video ({', '.join(VIDEOS)})")
    if source.is_dir() and not _holds_capture(source):
        raise ValueError(f"{source}: no photographs in it; choose the folder that holds them, or its parent")
    return OpenScene(scene_name(source), source, runs / scene_name(source))


def _holds_capture(folder: Path) -> bool:
    """Return whether a folder has a scene.yaml, a capture of a known layout, or photographs."""
    if (folder / "scene.yaml").is_file() or detect_layout(folder) != "photos":
        return True
    places = (folder, *(folder / name for name in ("images", "photos", "input")))
    return any(path.suffix.lower() in ENDINGS for place in places if place.is_dir() for path in place.iterdir())


def _list_homes(runs: Path) -> dict[Path, Path]:
    """Return source -> runs/<scene>, for the scenes that have run. The folder or video may be there no longer."""
    found = {}
    for home in runs.iterdir() if runs.is_dir() else ():
        source = home / "source"
        if home.name[0] != "." and "@" not in home.name and source.is_file():
            folder = root() / source.read_text(encoding="utf-8").strip()
            if folder.name == FRAMES and (record := folder / "frames.json").is_file():
                folder = Path(load_json(record)["video"])
            found[folder.resolve()] = home
    return found


def _is_finished(home: Path) -> bool:
    """Return whether the stage `evaluate` of a scene has finished."""
    return (home / "evaluate" / "receipt.json").is_file()


def _find_lost(text: str, runs: Path) -> Path | None:
    """Return the source of a finished scene, named by its name or path, that is there no longer."""
    lost = {source: home for source, home in _list_homes(runs).items() if not source.exists() and _is_finished(home)}
    return next((source for source, home in lost.items() if text in (str(source), home.name)), None)


def list_recent(runs: Path) -> list[dict[str, object]]:
    """Return the `MAX_RECENT` scenes of `runs` and data/ whose folders changed last, latest first.

    Variants of a scene are left out.

    Args:
        runs: the folder of all runs.

    Returns:
        For each scene "name", "path", "state" ("finished", "begun" or "new") and "lost", which is True if the
        photographs are there no longer. Of lost scenes only finished ones are listed.
    """
    found: dict[Path, tuple[float, str]] = {}
    for source, home in _list_homes(runs).items():
        state = "finished" if _is_finished(home) else "begun"
        if source.exists() or state == "finished":
            found[source] = (max(path.stat().st_mtime for path in (home, home / "source")), state)
    data = workplace(root()) / "data"
    for path in data.iterdir() if data.is_dir() else ():
        is_scene = path.is_dir() and path.name[0] not in "._" and _holds_capture(path)
        if is_scene or path.suffix.lower() in VIDEOS:
            found.setdefault(path.resolve(), (path.stat().st_mtime, "new"))
    latest = sorted(found.items(), key=lambda each: -each[1][0])[:MAX_RECENT]
    return [
        {"name": _name(path), "path": str(path), "state": state, "lost": not path.exists()}
        for path, (_, state) in latest
    ]


def _name(source: Path) -> str:
    """Return the name of a scene, as `scene_name` does, whose folder or video may be there no longer."""
    return source.stem if source.suffix.lower() in VIDEOS and not source.is_dir() else source.name
