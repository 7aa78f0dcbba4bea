"""Names the files of a scene folder that would be used if they had another form, and says what to do with them.

They are pictures in formats that are not read, videos, archives, and poses of programs whose files are not read.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from reffusion.capture.names import list_pictures, shorten_path, strip_ending
from reffusion.io.files import VIDEOS, BadInput

if TYPE_CHECKING:
    from reffusion.capture.layouts.capture import Capture

RAW = (".dng", ".raw", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw", ".x3f", ".3fr")
PICTURES = {  # ending -> (kind of picture, what to do)
    **dict.fromkeys(RAW, ("camera raw", "develop them to JPEG")),
    **dict.fromkeys((".exr", ".hdr"), ("high dynamic range", "save them as JPEG")),
    **dict.fromkeys((".jxl", ".jp2", ".gif", ".psd"), ("a format of pictures that is not read", "save them as JPEG")),
}
ARCHIVES = (".zip", ".7z", ".rar", ".tar", ".gz", ".r3d")
HEAD = 4000  # bytes at the beginning of a file in which `PoseFile.word` is looked for
DEPTHS = ("*", "*/*", "*/*/*", "*/*/*/*")  # patterns of paths at which pictures and videos are looked for
MOST = 20  # files of one pattern that are looked at
EXPORT = "export a COLMAP model or transforms.json from it"


@dataclass(frozen=True)
class PoseFile:
    """A kind of file with poses that is not read.

    Attributes:
        pattern: pattern of its path, relative to the scene or to a folder of pictures.
        program: the program that writes it, or a description.
        remedy: what the user may do, so that the poses are read.
        word: bytes that its beginning contains; empty if the name is enough.
    """

    pattern: str
    program: str
    remedy: str = EXPORT
    word: bytes = b""


POSE_FILES = (
    *(
        PoseFile(
            f"{depth}*.[xX][mM][pP]",
            "RealityCapture",
            "export its Internal/External camera parameters (.csv)",
            b"capturingreality",
        )
        for depth in ("", "*/")
    ),
    PoseFile("*.xml", "Metashape", EXPORT, b"<chunk"),
    PoseFile("*.xml", "ContextCapture", EXPORT, b"<BlocksExchange"),
    *(
        PoseFile(name, "Record3D", "convert it to transforms.json, or export the capture anew by Polycam", b'"poses"')
        for name in ("metadata.json", "metadata")
    ),
    PoseFile("odometry.csv", "Stray Scanner", "convert it to transforms.json"),
    PoseFile("frame_*.json", "3D Scanner App", "convert it to transforms.json", b"cameraPose"),
    PoseFile("sfm_data.json", "OpenMVG", "convert it by openMVG_main_openMVG2Colmap"),
    PoseFile("*.sfm", "Meshroom", EXPORT),
    PoseFile("*.nvm", "VisualSFM", EXPORT),
    PoseFile("*calibrated_camera_parameters*.txt", "Pix4D", "export bundle.out from it"),
    PoseFile(
        "*.csv",
        "RealityCapture",
        "export its Internal/External camera parameters to the scene's folder, with commas between columns",
        b"heading",
    ),
    PoseFile("*.csv", "a table of omega, phi and kappa", "export a COLMAP model or Bundler's bundle.out", b"appa"),
    PoseFile("cams/*_cam.txt", "MVSNet", "convert them to transforms.json"),
    PoseFile("pose/*.txt", "NSVF, ScanNet", "convert them to transforms.json"),
    PoseFile("groundtruth.txt", "TUM", "convert it to transforms.json"),
    PoseFile("sensors/trajectories.txt", "Kapture", "convert it by kapture_export_colmap.py"),
    PoseFile("*.pose.txt", "7-Scenes", "convert them to transforms.json"),
    PoseFile("cameras*.npz", "NeuS", "convert it to transforms.json"),
    PoseFile("odm_report/shots.geojson", "OpenDroneMap", "copy the project's opensfm/reconstruction.json here"),
    PoseFile("cameras.json", "not of 3D Gaussian Splatting", EXPORT),
    PoseFile("transforms_train.json", "ns-export cameras, without focal lengths", "add fl_x to its frames"),
    PoseFile("transforms_test.json", "test frames alone", "add transforms_train.json"),
    *(
        PoseFile(f"{depth}{name}", "COLMAP, elsewhere or incomplete", "move the complete model to sparse/0", word)
        for depth in ("", "*/", "*/*/", "*/*/*/")
        for name, word in (("images.bin", b""), ("images.txt", b"CAMERA_ID"))
    ),
    PoseFile("*/transforms.json", "nerfstudio, in a sub-folder", "move it to the scene's folder"),
)


def add_warnings(folder: Path, capture: Capture) -> Capture:
    """Return the capture with warnings about pictures that are not read and, if it has no poses, files with poses.

    Pictures that are not read count as left out, so that their masks are not refused. A picture that the capture also
    holds in another format, under the same name, needs no warning.

    Args:
        folder: the scene's folder.
    """
    places = sorted({path.parent for path in capture.pictures.values()})
    known = {strip_ending(path) for paths in capture.paths.values() for path in paths}
    known |= {strip_ending(path.name) for path in capture.pictures.values()}
    found = {place: [path for path in _unread_pictures(place) if path.stem not in known] for place in places}
    lost = {path.name: (path.stem, path.name) for paths in found.values() for path in paths}
    warnings = [each for place, paths in found.items() for each in _describe_pictures(folder, place, paths)]
    if capture.poses is None:
        warnings += describe_poses(folder, places)
    return replace(capture, paths=lost | capture.paths, warnings=(*capture.warnings, *warnings))


def describe_poses(folder: Path, places: Sequence[Path]) -> list[str]:
    """Return a sentence for each file with poses that is not read, one of each kind, in `folder` and in `places`."""
    sentences: dict[Path, str] = {}
    for kind in POSE_FILES:
        files = [path for place in dict.fromkeys((folder, *places)) for path in sorted(place.glob(kind.pattern))]
        path = next((path for path in files[:MOST] if path.is_file() and _begins_with(path, kind.word)), None)
        if path is not None:
            sentences[path] = (
                f"{shorten_path(path, folder)} ({kind.program}) is not read; {kind.remedy}; without that, poses are "
                "solved anew, in another frame"
            )
    return list(sentences.values())


def _begins_with(path: Path, word: bytes) -> bool:
    with open(path, "rb") as file:
        return word in file.read(HEAD)


def refuse_without_pictures(folder: Path, usual: Sequence[str]) -> BadInput:
    """Return the error of a scene folder without pictures in the `usual` folders; the message suggests a remedy."""
    places = [folder / name for name in usual]
    hints = [each for place in places for each in _describe_pictures(folder, place, _unread_pictures(place))]
    files = [path for pattern in DEPTHS for path in sorted(folder.glob(pattern)) if not path.name.startswith(".")]
    hints += [f"give the video itself: scene={path}" for path in files if path.suffix.lower() in VIDEOS]
    hints += [
        f"{shorten_path(path, folder)} holds {count} picture{'s' * (count > 1)}: "
        + (
            f"name their folder as `images: {path.name}` in scene.yaml"
            if path.parent == folder
            else f"give the folder of the capture: scene={folder / path.relative_to(folder).parts[0]}"
        )
        for path in sorted(files, key=lambda path: path.name not in usual)
        if path.is_dir() and (count := len(list_pictures(path)))
    ]
    hints += [f"unpack {path.name}" for path in files if path.suffix.lower() in ARCHIVES]
    hint = hints[0] if hints else "name their folder as `images` in scene.yaml"
    return BadInput(f"{folder}: no pictures in {', '.join(usual)}; {hint}")


def _unread_pictures(place: Path) -> list[Path]:
    """Return the pictures in a folder whose formats are not read, sorted."""
    files = place.iterdir() if place.is_dir() else ()
    return sorted(path for path in files if path.suffix.lower() in PICTURES and not path.name.startswith("."))


def _describe_pictures(folder: Path, place: Path, pictures: Sequence[Path]) -> list[str]:
    """Return a sentence for each ending of the pictures, all of which lie in `place`."""
    where = "the folder" if place == folder else shorten_path(place, folder)
    counts = Counter(path.suffix for path in pictures)
    return [
        f"{where} holds {count} {ending} pictures ({PICTURES[ending.lower()][0]}), which are not read; "
        f"{PICTURES[ending.lower()][1]}"
        for ending, count in counts.items()
    ]
