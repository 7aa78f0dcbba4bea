"""A hole that deleting left, patched: `python -m benchmarks.studies.patching write`.

The fit of a finished scene is what an artist opens; a box around the object's splats is deleted, and the rest saved as
an editor does: in another order, quantised, without spherical harmonics. `write` makes three scenes of it in --out:
with the photographs, with the capture's cameras alone, and with neither. `make scene=... patch` patches each; `score`
renders the patched files from the test views, beside the run's own result: PSNR in the box, and a sheet of pictures.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from reffusion.io.arrays import load_labels, save_json, save_text
from reffusion.io.compressed import save_compressed
from reffusion.io.images import load_image, load_mask, save_image, to_uint8
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import load_object, load_scene
from reffusion.score import metrics
from reffusion.splat import rasterizer
from reffusion.types import Scene, Similarity

KINDS = ("photographs", "cameras", "neither")
TRIMMED = 0.2  # percent of the object's splats on each side that are beyond the box: floaters
SHOWN = 4  # test views on the sheet


def in_box(means: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """bool [N]: the splats in the smallest box around the object, which a person would turn until it fits."""
    thing, draws, box = means[labels], np.random.default_rng(0), Rotation.identity()
    bounds = lambda turn: np.percentile(turn.apply(thing), (TRIMMED, 100 - TRIMMED), axis=0)
    volume = lambda turn: float(np.prod(np.diff(bounds(turn), axis=0)))
    for spread in np.geomspace(1.5, 0.01, 40):  # radians
        tries = [box, *(Rotation.from_rotvec(v) * box for v in draws.normal(0, spread, (30, 3)))]
        box = min(tries, key=volume)
    along, (low, high) = box.apply(means), bounds(box)
    return ((along >= low) & (along <= high)).all(1)


def write(run: Path, scene: Path, out: Path) -> None:
    """The three scenes' folders in `out`."""
    placed, gaussians = load_scene(run / "poses"), load_ply(run / "fit" / "gaussians.ply")
    deleted = torch.from_numpy(in_box(gaussians.means.double().numpy(), load_object(run / "masks").numpy()))
    left = gaussians.map(lambda p: p[~deleted])
    stripped = type(left)(left.means, left.quaternions, left.log_scales, left.opacity_logits, left.sh[:, :1])
    reference = next((run / "reference" / "references").glob("*.png"))
    width = max(max(camera.width, camera.height) for camera in placed.cameras.values())
    for kind in KINDS:
        folder = out / f"patch-{kind}"
        shutil.rmtree(folder, ignore_errors=True)
        save_ply(folder / "scene.ply", gaussians, placed.similarity)
        save_compressed(folder / "cleaned.compressed.ply", stripped, placed.similarity)
        said = f"gaussians: scene.ply\ncleaned: cleaned.compressed.ply\nstages: {{poses: {{longest: {width}}}}}\n"
        if kind == "photographs":
            shutil.copytree(scene / "images_4", folder / "images_4")
            shutil.rmtree(folder / "images_4" / "label")
            for name in ("sparse", "poses_bounds.npy"):
                (shutil.copytree if (scene / name).is_dir() else shutil.copy)(scene / name, folder / name)
            said += "masks: none\n"
        if kind == "cameras":
            shutil.copytree(scene / "sparse", folder / "sparse")
        if kind != "neither":
            shutil.copy(reference, folder / "reference.png")
            said += f"reference: {{view: {reference.stem}, image: reference.png, undistorted: true}}\n"
        save_text(folder / "scene.yaml", said)
    own = load_labels(run / "masks" / "labels.npy")
    print(f"{int(deleted.sum())} of {len(gaussians)} splats deleted; the run itself removed {int(own.sum())}")


def score(run: Path, out: Path, runs: Path) -> None:
    """Write patching.json and patching.png to `out`."""
    placed = load_scene(run / "poses")
    files = {"own result": run / "evaluate" / "scene.ply", "as given": out / "patch-photographs" / "scene.ply"}
    files |= {kind: runs / f"patch-{kind}" / "patch" / "patched.ply" for kind in KINDS}
    together = {title: (path,) for title, path in files.items()}
    for kind in KINDS:
        cleaned = out / f"patch-{kind}" / "cleaned.compressed.ply"
        together[f"{kind}: cleaned and new"] = cleaned, files[kind].with_name("new.ply")
    found, rows, some = {}, [], placed.test[:: max(1, len(placed.test) // SHOWN)][:SHOWN]
    for title, parts in together.items():
        if all(path.exists() for path in parts):
            pictures = renders(parts, placed, placed.similarity)
            found[title] = box_psnr(pictures, run, placed)
            rows.append(np.concatenate([pictures[name] for name in some], 1))
            print(f"{title}: {found[title]:.2f} dB", flush=True)
    save_json(out / "patching.json", found)
    save_image(out / "patching.png", np.concatenate(rows))


def renders(parts: tuple[Path, ...], placed: Scene, similarity: Similarity) -> dict[str, np.ndarray]:
    """Test view -> uint8 [H, W, 3], of the files' splats together."""
    first, *others = (load_ply(path, similarity) for path in parts)
    for other in others:
        most = max(first.sh.shape[1], other.sh.shape[1])
        wide = lambda g, most=most: torch.cat([g.sh, g.sh.new_zeros(len(g), most - g.sh.shape[1], 3)], 1)
        both = (type(first)(g.means, g.quaternions, g.log_scales, g.opacity_logits, wide(g)) for g in (first, other))
        first = next(both).zipped(next(both), lambda a, b: torch.cat([a, b]))
    with torch.no_grad():
        return {n: to_uint8(rasterizer.render(first, placed.cameras[n]).color.numpy()) for n in placed.test}


def box_psnr(pictures: dict[str, np.ndarray], run: Path, placed: Scene) -> float:
    values = []
    for name, picture in pictures.items():
        box = metrics.mask_box(load_mask(run / "poses" / "test_masks" / f"{name}.png"))
        values.append(metrics.psnr(box.crop(picture), box.crop(load_image(run / "poses" / "images" / f"{name}.png"))))
    return float(np.mean(values))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--run", type=Path, default=Path("runs/demo"))
    parser.add_argument("--scene", type=Path, default=Path("data/demo"))
    parser.add_argument("--out", type=Path, default=Path("runs/patching"))
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("what", choices=("write", "score"))
    arguments = parser.parse_args()
    if arguments.what == "write":
        write(arguments.run, arguments.scene, arguments.out)
    else:
        score(arguments.run, arguments.out, arguments.runs)


if __name__ == "__main__":
    main()
