"""Accuracy of poses found from photographs alone: `python -m lab.studies.bare_photographs ../shared/data/fox`.

The stage `poses` gets the photographs of captures with known poses, but not these poses, and finds poses by structure
from motion. The found poses are aligned to the known ones by the best similarity transform. Errors of camera centers
are in % of the extent (the largest distance between two centers), errors of rotations in degrees. Structure from motion
does not estimate the principal point; a principal point off the image center appears as an error of the rotations. The
study prints two rows per capture, before and after the adjustment to optical flow (`poses.refine`), and writes
bare_photographs.json to --out.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from reffusion.capture.load import load_capture
from reffusion.capture.normalized_frame import camera_centers
from reffusion.io.arrays import load_json
from reffusion.io.scene import load_scene
from stages import poses

COLUMNS = (
    "capture",
    "views",
    "cameras",
    "center_median",
    "center_worst",
    "rotation_median",
    "rotation_worst",
    "points",
    "residual_px",
    "cpu_seconds",
)


def pose_errors(estimate: Mapping[str, np.ndarray], truth: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Compare poses after the similarity transform of the estimate that aligns the camera centers best (least squares).

    Args:
        estimate: view -> world-to-camera pose [4, 4].
        truth: view -> world-to-camera pose [4, 4].

    Returns:
        For the V views that both have, sorted by name: distances of centers [V] in % of the extent of the true centers
        (the largest distance between two of these), and rotation errors [V] in degrees.
    """
    names = sorted(set(estimate) & set(truth))
    poses_a, poses_b = (np.stack([poses[name] for name in names]) for poses in (estimate, truth))
    a, b = camera_centers(poses_a), camera_centers(poses_b)
    a, b = a - a.mean(0), b - b.mean(0)
    u, stretch, v = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    turn = u @ np.diag(sign) @ v
    aligned = (stretch * sign).sum() / (a**2).sum() * a @ turn.T
    extent = np.linalg.norm(b[:, None] - b, axis=-1).max()
    rotations = Rotation.from_matrix(poses_b[:, :3, :3] @ turn @ poses_a[:, :3, :3].transpose(0, 2, 1))
    return 100 * np.linalg.norm(aligned - b, axis=1) / extent, np.degrees(rotations.magnitude())


def evaluate_capture(folder: Path, images: str | None, every: int, longest: int) -> list[dict]:
    """Find poses of a capture's photographs and return two rows of the table: as solved, and as adjusted to flow.

    If the adjustment is not accepted, the second row has the solved poses ("left by flow"). A row maps `COLUMNS` to
    values.

    Args:
        folder: folder of the capture.
        images: folder of pictures inside the capture; None for the default.
        every: every n-th photograph by name is taken.
        longest: longest side to which the photographs are reduced, px.
    """
    capture = load_capture(folder, images=images)
    names = sorted(capture.pictures)[::every]
    truth = {name: capture.poses.world_to_camera[name] for name in names}
    result = []
    with tempfile.TemporaryDirectory() as work:
        scene = Path(work) / "scene"
        (scene / "images").mkdir(parents=True)
        for name in names:
            shutil.copy(capture.pictures[name], scene / "images")
        for refine in (False, True):
            out = Path(work) / f"poses-{refine}"
            out.mkdir()
            start = time.process_time()
            poses.run(poses.Params(masks="none", longest=longest, refine=refine), out, scene=scene)
            seconds, facts = time.process_time() - start, load_json(out / "sfm.json")
            adjusted = refine and load_json(out / "refine.json")["after"] is not None
            estimate = {name: camera.world_to_camera for name, camera in load_scene(out).cameras.items()}
            centers, degrees = pose_errors(estimate, truth)
            values = (
                f"{folder.name}/{every}",
                f"{facts['placed']} of {facts['photographs']}",
                "adjusted to flow" if adjusted else "left by flow" if refine else "solved",
                *(float(reduced) for each in (centers, degrees) for reduced in (np.median(each), each.max())),
                facts["points"],
                facts["mean_residual_px"],
                seconds,
            )
            result.append(dict(zip(COLUMNS, values, strict=True)))
    return result


def format_row(row: dict) -> str:
    """Return a row of the Markdown table."""
    cells = (f"{value:.2f}" if isinstance(value, float) else str(value) for value in row.values())
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, nargs="+", help="folders with photographs and poses")
    parser.add_argument("--every", type=int, default=2, help="take every n-th photograph by name")
    parser.add_argument("--images", help="folder of pictures inside the capture")
    parser.add_argument("--longest", type=int, default=640, help="px of the longer side, as poses.longest")
    parser.add_argument("--out", type=Path, default=Path("runs/bare_photographs"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    table = []
    for folder in arguments.captures:
        for row in evaluate_capture(folder, arguments.images, arguments.every, arguments.longest):
            table.append(row)
            print(format_row(row), flush=True)
    (arguments.out / "bare_photographs.json").write_text(json.dumps(table, indent=1))


if __name__ == "__main__":
    main()
