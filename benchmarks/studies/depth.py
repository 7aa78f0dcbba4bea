"""Completed depth in the hole against ray-cast truth: `python -m benchmarks.studies.depth --scene data/demo-table`.

The stage `initialize` completes the depth behind the object in the hole of each reference. The study compares this
depth with the true camera z of the room without the object. It prints the share of pixels whose error is within 1, 2
and 5 % of the true depth, and the median error: for all pixels of the hole, for those near a step of the true depth,
for those away from steps, and for other parts of the view (see `measure`). It writes a picture per reference:
reference, true depth, completed depth, and the error, red where the depth is too far, blue where it is too near. The
scene must be made by the generator, which alone knows the truth. The depth outside the masks must agree with the truth;
otherwise the poses are not in the frame of the truth.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from benchmarks.studies.masks import true_never_seen
from reffusion.geometry import pixel_rays
from reffusion.io.arrays import load_json
from reffusion.io.images import load_exr, save_image
from reffusion.io.scene import load_mask_sets, load_references, load_scene
from reffusion.types import Camera, Reference, Similarity

DATA = Path(__file__).resolve().parents[2] / "data"
KINDS = (
    "wide",
    "360",
    "seen",
    "behind",
    "beside",
    "pair",
    "table",
    "corner",
    "grass",
    "mini",
)  # kinds that a scene's name may contain; a scene whose name contains none is of the kind demo
WITHIN = (0.01, 0.02, 0.05)  # limits of the error relative to the true depth
# A pixel is at a step of the depth if the slope of disparity changes there by more than 2 % of the disparity. Pixels
# within 4 px of such a pixel are near an edge.
EDGE, NEAR = 0.02, 4
MAX_OUTSIDE_ERROR = 0.02  # largest median error outside the masks that an inaccurate fit can explain
CLIP, MARGIN, SIDE = 0.05, 12, 480  # relative error of full colour; margin around the hole, px; least panel width, px


def scene_kind(name: str) -> str:
    """Return the kind of a made scene from its name: "table" for `demo-table-21`; "demo" if no part is in `KINDS`."""
    return next((part for part in name.split("-") if part in KINDS), "demo")


def scene_pose(camera: Camera, similarity: Similarity) -> np.ndarray:
    """Return a camera's world-to-camera pose [4, 4] in the scene's own frame and unit.

    Args:
        camera: camera in the normalised frame.
        similarity: transform from the scene's own frame to the normalised frame.
    """
    pose = camera.world_to_camera.copy()
    pose[:3, 3] = pose[:3, 3] / similarity.scale - pose[:3, :3] @ similarity.offset
    return pose


def true_depth(seed: int, kind: str, camera: Camera, similarity: Similarity) -> np.ndarray:
    """Compute the true depth without the object, [H, W] camera z in the unit of the normalised frame.

    The generator does this in a separate process.

    Args:
        seed: seed of the scene.
        kind: kind of the scene.
        camera: camera in the normalised frame.
        similarity: transform from the scene's own frame to the normalised frame.
    """
    with tempfile.TemporaryDirectory() as folder:
        view, output = Path(folder) / "view.npz", Path(folder) / "depth.npy"
        np.savez(view, world_to_camera=scene_pose(camera, similarity), rays=pixel_rays(camera)[..., :2])
        options = ["--seed", str(seed), "--kind", kind, "--view", str(view), "--out", str(output)]
        subprocess.run([sys.executable, str(DATA / "depths.py"), *options], check=True)
        return np.load(output) * similarity.scale


def near_edges(depth: np.ndarray) -> np.ndarray:
    """Return bool [H, W], True for pixels within `NEAR` px of a step of the depth.

    Steps are found in disparity, which is linear over a plane of any slant.
    """
    padded = np.pad(1 / depth, 1, mode="edge")
    middle = padded[1:-1, 1:-1]
    across = np.abs(padded[1:-1, :-2] - 2 * middle + padded[1:-1, 2:])
    down = np.abs(padded[:-2, 1:-1] - 2 * middle + padded[2:, 1:-1])
    across[:, [0, -1]], down[[0, -1]] = 0, 0  # border pixels lack a neighbour
    step = np.maximum(across, down) > EDGE * middle
    return cv2.distanceTransform((~step).astype(np.uint8), cv2.DIST_L2, 5) <= NEAR if step.any() else step


def relative_errors(depth: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return the error relative to the true depth, [H, W]: positive if too far, infinite where there is no depth."""
    return np.where(np.isfinite(depth) & (depth > 0), depth / true - 1, np.inf)


def scores(error: np.ndarray) -> dict[str, float]:
    """Return the scores of relative errors [P].

    Returns:
        "pixels": P; "within 1%" etc.: shares of pixels in [0, 1]; "median": median absolute error; "bias": median of
        the signed error. Only "pixels" if P is 0.
    """
    if not error.size:
        return {"pixels": 0}
    shares = {f"within {limit:.0%}": float((np.abs(error) <= limit).mean()) for limit in WITHIN}
    return {"pixels": error.size, **shares, "median": float(np.median(np.abs(error))), "bias": float(np.median(error))}


def error_sheet(reference: Reference, true: np.ndarray, depth: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return a picture, uint8 [h, w, 3], of reference, true depth, completed depth and error, side by side.

    The panels show the surroundings of the hole, with the hole outlined.

    Args:
        reference: the reference with its hole.
        true: [H, W], true depth.
        depth: [H, W], completed depth.
        error: [H, W], result of `relative_errors`.
    """
    mask = reference.mask
    near, far = np.percentile(1 / true[mask], (99.5, 0.5))
    far, near = min(far, near / 1.02) / 1.02, near * 1.02
    greys = [np.clip((1 / np.maximum(z, 1e-9) - far) / (near - far), 0, 1) for z in (true, depth)]
    depths = [cv2.applyColorMap(np.uint8(255 * grey), cv2.COLORMAP_VIRIDIS)[..., ::-1] for grey in greys]
    share = np.clip(error / CLIP, -1, 1)[..., None]
    signed = 255 * (1 - np.where(share > 0, share * [0, 1, 1], -share * [1, 1, 0]))
    row, column = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    cut = tuple(slice(max(span[0] - MARGIN, 0), span[-1] + MARGIN + 1) for span in (row, column))
    larger = -(-SIDE // (cut[1].stop - cut[1].start))
    panels = []
    for panel in (reference.image, *depths, np.where(mask[..., None], signed, 200).astype(np.uint8)):
        cell = np.ascontiguousarray(panel[cut].repeat(larger, 0).repeat(larger, 1))
        outline, _ = cv2.findContours(
            mask[cut].astype(np.uint8).repeat(larger, 0).repeat(larger, 1), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE
        )
        panels.append(cv2.drawContours(cell, outline, -1, (255, 255, 255), 1))
    return np.concatenate(panels, 1)


def measure(scene_folder: Path, run: Path, out: Path, kind: str) -> dict[str, dict[str, dict[str, float]]]:
    """Score the completed depth of all references of a run, and write a picture of each to `out`.

    The parts of a view are the "hole"; its pixels "near edges" of the true depth and those "elsewhere"; the "rest of
    C", the pixels of the consistent mask (those that show the object) outside the hole, whose background other views
    should show; "never seen", the pixels whose background truly no training view shows; and "outside", the pixels
    outside all masks, away from edges.

    Args:
        scene_folder: folder of a scene made by the generator.
        run: runs/<scene>.
        out: folder for the pictures.
        kind: kind of the scene.

    Returns:
        View -> part -> scores.

    Raises:
        ValueError: no reference's depth was completed, or depth and truth differ outside the masks.
    """
    seed, scene = load_json(scene_folder / "truth/facts.json")["seed"], load_scene(run / "poses")
    results = {}
    for reference in load_references(run / "reference", scene):
        name = reference.camera.name
        file = run / "initialize/depth" / f"{name}.exr"
        if not file.exists():
            continue
        completed_depth, true = load_exr(file).astype(float), true_depth(seed, kind, reference.camera, scene.similarity)
        error, edges, mask = relative_errors(completed_depth, true), near_edges(true), reference.mask
        sets = load_mask_sets(run / "masks", [name])[name]
        hidden = sets.raw | sets.consistent | mask
        parts = {"hole": mask, "near edges": mask & edges, "elsewhere": mask & ~edges}
        never = true_never_seen(scene_folder, [reference.camera])[name]
        parts |= {"rest of C": sets.consistent & ~mask, "never seen": never, "outside": ~hidden & ~edges}
        results[name] = {part: scores(error[pixels]) for part, pixels in parts.items()}
        if not results[name]["outside"].get("median", 0) < MAX_OUTSIDE_ERROR:
            outside = results[name]["outside"]
            raise ValueError(f"{name}: depth outside the masks is not the true one ({outside}); is --kind right?")
        save_image(out / f"{name}.png", error_sheet(reference, true, completed_depth, error))
    if not results:
        raise ValueError(f"{run / 'initialize/depth'}: no depth of a reference; run `make scene=... initialize`")
    return results


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, required=True, help="a scene's folder made by data/generate.py")
    parser.add_argument("--run", type=Path, help="default: runs/<scene's name>")
    parser.add_argument("--out", type=Path, help="default: runs/depth/<scene's name>")
    parser.add_argument("--kind", choices=("demo", *KINDS), help="kind of the scene; default: taken from its name")
    arguments = parser.parse_args()
    name = arguments.scene.resolve().name
    run, out = arguments.run or Path("runs") / name, arguments.out or Path("runs/depth") / name
    for path in (arguments.scene / "truth/facts.json", run / "initialize/facts.json"):
        if not path.exists():
            raise ValueError(
                f"{path} is missing: make the scene with data/generate.py, and run `make scene=... initialize`"
            )
    results = measure(arguments.scene, run, out, arguments.kind or scene_kind(name))
    (out / "depth.json").write_text(json.dumps(results, indent=1))
    for view, parts in results.items():
        for part, row in parts.items():
            if row["pixels"]:
                shares = ", ".join(f"{row[f'within {limit:.0%}']:6.1%} within {limit:.0%}" for limit in WITHIN)
                middle = f"median error {row['median']:.2%} ({row['bias']:+.2%})"
                print(f"{name} {view} {part:10} {row['pixels']:6} px: {shares}, {middle}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
