"""Filling of a hole from which splats were deleted: `python -m benchmarks.studies.patching write`.

The study imitates a user of an editor, who opens the fit of a finished scene, deletes all splats in a box around the
object, and saves the rest in another order, quantised and without spherical harmonics. The action `write` makes three
scenes from the two files in --out: with the photographs, with the capture's cameras only, and with neither.
`make scene=... patch` fills the hole of each scene. The action `score` then renders the filled scenes from the test
views, beside the run's own result, and writes the PSNR in the box and a sheet of pictures.

The action `command` measures `reffusion patch before.ply after.ply`: splat-transform, an npm package, deletes the
object from the file that `export` wrote, and opens the filled scene. `score` includes this result.
"""

from __future__ import annotations

import argparse
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from reffusion.io.arrays import load_json, load_labels, save_json, save_text
from reffusion.io.compressed import save_compressed
from reffusion.io.images import load_image, load_mask, save_image, to_uint8
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.ply_table import load_header, load_vertices, save_vertices
from reffusion.io.scene import load_object_labels, load_scene
from reffusion.metrics import image_metrics
from reffusion.splat import rasterizer
from reffusion.types import Scene, Similarity
from report import patch_files

KINDS = ("photographs", "cameras", "neither")  # what a scene has beside the two files of splats
COMMANDS = ("command, cameras", "command, two files alone")  # runs of the command with and without cameras
TRIMMED = 0.2  # percent of the object's splats on each side that the box leaves out, because they may be floaters
SHOWN = 4  # test views on the sheet


def in_box(means: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Return bool [N], True for the splats in the smallest rotated box around the object.

    The box leaves out `TRIMMED` percent of the object's splats at each end of each axis.

    Args:
        means: [N, 3].
        labels: bool [N], True for splats of the object.
    """
    thing, draws, box = means[labels], np.random.default_rng(0), Rotation.identity()
    bounds = lambda turn: np.percentile(turn.apply(thing), (TRIMMED, 100 - TRIMMED), axis=0)
    volume = lambda turn: float(np.prod(np.diff(bounds(turn), axis=0)))
    for spread in np.geomspace(1.5, 0.01, 40):  # radians
        tries = [box, *(Rotation.from_rotvec(v) * box for v in draws.normal(0, spread, (30, 3)))]
        box = min(tries, key=volume)
    along, (low, high) = box.apply(means), bounds(box)
    return ((along >= low) & (along <= high)).all(1)


def write_scenes(run: Path, scene: Path, out: Path) -> None:
    """Write the folders of the three scenes to `out`.

    Each folder has scene.yaml and two files of splats, before and after the deletion of the object. "photographs" and
    "cameras" also have the cameras and the reference, and "photographs" has the photographs.

    Args:
        run: finished run of the scene.
        scene: folder of the scene with its photographs.
        out: folder to write to.
    """
    placed, gaussians = load_scene(run / "poses"), load_ply(run / "fit" / "gaussians.ply")
    deleted = torch.from_numpy(in_box(gaussians.means.double().numpy(), load_object_labels(run / "masks").numpy()))
    rest = gaussians.map(lambda p: p[~deleted])
    stripped = type(rest)(rest.means, rest.quaternions, rest.log_scales, rest.opacity_logits, rest.sh[:, :1])
    reference = next((run / "reference" / "references").glob("*.png"))
    width = max(max(camera.width, camera.height) for camera in placed.cameras.values())
    for kind in KINDS:
        folder = out / f"patch-{kind}"
        shutil.rmtree(folder, ignore_errors=True)
        save_ply(folder / "scene.ply", gaussians, placed.similarity)
        save_compressed(folder / "cleaned.compressed.ply", stripped, placed.similarity)
        text = f"gaussians: scene.ply\ncleaned: cleaned.compressed.ply\nstages: {{poses: {{longest: {width}}}}}\n"
        if kind == "photographs":
            shutil.copytree(scene / "images_4", folder / "images_4")
            shutil.rmtree(folder / "images_4" / "label")
            for name in ("sparse", "poses_bounds.npy"):
                (shutil.copytree if (scene / name).is_dir() else shutil.copy)(scene / name, folder / name)
            text += "masks: none\n"
        if kind == "cameras":
            shutil.copytree(scene / "sparse", folder / "sparse")
        if kind != "neither":
            shutil.copy(reference, folder / "reference.png")
            text += f"reference: {{view: {reference.stem}, image: reference.png, undistorted: true}}\n"
        save_text(folder / "scene.yaml", text)
    own = load_labels(run / "masks" / "labels.npy")
    print(f"{int(deleted.sum())} of {len(gaussians)} splats deleted; the run itself removed {int(own.sum())}")


def delete_object(run: Path, folder: Path, tool: list[str]) -> None:
    """Write a scene with and without its object: before.ply, after.ply and cameras/, in the frame of the capture.

    before.ply is the export's with_object.ply. Its copy selected.ply has a further column `selected`, 1 for the splats
    in a box around the object. splat-transform reads this copy and deletes these splats. The folder cameras/ has the
    cameras and photographs of the training views.

    Args:
        run: run of the scene, with its export.
        folder: folder to write to; emptied first.
        tool: command that runs splat-transform.
    """
    exported, placed = run / "export", load_scene(run / "poses")
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "cameras").mkdir(parents=True)
    shutil.copy(exported / "with_object.ply", folder / "before.ply")
    table = load_vertices(folder / "before.ply", load_header(folder / "before.ply"))
    selected = in_box(load_ply(folder / "before.ply").means.double().numpy(), load_object_labels(run / "masks").numpy())
    marked = np.empty(len(table), [*table.dtype.descr, ("selected", "f4")])
    for name in table.dtype.names:
        marked[name] = table[name]
    marked["selected"] = selected
    save_vertices(folder / "selected.ply", marked)
    line = [*tool, "-q", "-w", str(folder / "selected.ply"), "-V", "selected,lt,0.5", str(folder / "after.ply")]
    subprocess.run(line, check=True)
    cameras = load_json(exported / "cameras" / "transforms.json")
    photographs = {f"images/{name}.png" for name in placed.train}
    cameras["frames"] = [frame for frame in cameras["frames"] if frame["file_path"] in photographs]
    save_json(folder / "cameras" / "transforms.json", cameras)
    shutil.copy(exported / "cameras" / "sparse_pc.ply", folder / "cameras")
    (folder / "cameras" / "images").mkdir()
    for name in placed.train:
        shutil.copy(exported / "cameras" / "images" / f"{name}.png", folder / "cameras" / "images")
    kept = len(load_ply(folder / "after.ply"))
    print(f"splat-transform deleted {len(table) - kept} of {len(table)} splats")


def run_patch_command(run: Path, out: Path, runs: Path, tool: list[str], set_: str) -> None:
    """Run `reffusion patch` twice: with cameras, photographs and the run's reference, and with the two files only.

    Before this, `delete_object` makes the two files. Afterwards splat-transform opens both results, as a test, and
    writes them again.

    Args:
        run: run of the scene, with its export.
        out: folder of the study.
        runs: folder of runs.
        tool: command that runs splat-transform.
        set_: parameters of the stages, as for `--set`.
    """
    folder = out / "command"
    delete_object(run, folder, tool)
    reference = next((run / "reference" / "references").glob("*.png"))
    for kind in COMMANDS:
        words = [str(folder / "before.ply"), str(folder / "after.ply"), "--profile", "laptop", "--set", set_]
        words += ["--runs", str(runs / "cameras" if kind == COMMANDS[0] else runs / "alone")]
        if kind == COMMANDS[0]:
            words += ["--cameras", str(folder / "cameras")]
            home = patch_files.find_folder(runs / "cameras", folder / "before.ply", folder / "after.ply")
            (home / "painted").mkdir(parents=True, exist_ok=True)
            shutil.copy(reference, home / "painted" / reference.name)
        words += ["--out", str(output_file(out, kind))]
        began = time.monotonic()
        subprocess.run([sys.executable, "-m", "reffusion.command", "patch", *words], check=True)
        again = output_file(out, kind).with_suffix(".compressed.ply")
        subprocess.run([*tool, "-q", "-w", str(output_file(out, kind)), str(again)], check=True)
        count = len(load_ply(again))
        print(f"{kind}: {time.monotonic() - began:.0f} s; splat-transform opens it, {count} splats", flush=True)


def output_file(out: Path, kind: str) -> Path:
    """Return the path of the filled scene that the command writes, for an entry of `COMMANDS`."""
    return out / "command" / ("cameras.ply" if kind == COMMANDS[0] else "alone.ply")


def score(run: Path, out: Path, runs: Path) -> None:
    """Score the filled scenes that exist, the run's own result and the scene with the object.

    Writes patching.json (title -> mean PSNR in the box, dB) and patching.png (a row of test views each) to `out`.
    """
    placed = load_scene(run / "poses")
    files = {"own result": run / "evaluate" / "scene.ply", "as given": out / "patch-photographs" / "scene.ply"}
    files |= {kind: runs / f"patch-{kind}" / "patch" / "patched.ply" for kind in KINDS}
    files |= {kind: output_file(out, kind) for kind in COMMANDS}
    together = {title: (path,) for title, path in files.items()}
    for kind in KINDS:
        cleaned = out / f"patch-{kind}" / "cleaned.compressed.ply"
        together[f"{kind}: cleaned and new"] = cleaned, files[kind].with_name("new.ply")
    scores, rows, some = {}, [], placed.test[:: max(1, len(placed.test) // SHOWN)][:SHOWN]
    for title, parts in together.items():
        if all(path.exists() for path in parts):
            pictures = render_test_views(parts, placed, placed.similarity)
            scores[title] = box_psnr(pictures, run, placed)
            rows.append(np.concatenate([pictures[name] for name in some], 1))
            print(f"{title}: {scores[title]:.2f} dB", flush=True)
    save_json(out / "patching.json", scores)
    save_image(out / "patching.png", np.concatenate(rows))


def render_test_views(parts: tuple[Path, ...], placed: Scene, similarity: Similarity) -> dict[str, np.ndarray]:
    """Render the test views from the splats of several files together, as {view: uint8 [H, W, 3]}.

    Args:
        parts: files of splats in the scene's own frame.
        placed: the scene with its cameras.
        similarity: transform from the scene's own frame to the normalised frame.
    """
    first, *others = (load_ply(path, similarity) for path in parts)
    for other in others:
        most = max(first.sh.shape[1], other.sh.shape[1])
        wide = lambda g, most=most: torch.cat([g.sh, g.sh.new_zeros(len(g), most - g.sh.shape[1], 3)], 1)
        both = (type(first)(g.means, g.quaternions, g.log_scales, g.opacity_logits, wide(g)) for g in (first, other))
        first = next(both).zip_map(next(both), lambda a, b: torch.cat([a, b]))
    with torch.no_grad():
        return {n: to_uint8(rasterizer.render(first, placed.cameras[n]).color.numpy()) for n in placed.test}


def box_psnr(pictures: dict[str, np.ndarray], run: Path, placed: Scene) -> float:
    """Return the mean PSNR in dB over the test views, in the box of each view's mask."""
    values = []
    for name, picture in pictures.items():
        box = image_metrics.mask_box(load_mask(run / "raw_masks" / "test_masks" / f"{name}.png"))
        values.append(
            image_metrics.psnr(box.crop(picture), box.crop(load_image(run / "poses" / "images" / f"{name}.png")))
        )
    return float(np.mean(values))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--run", type=Path, default=Path("runs/demo"))
    parser.add_argument("--scene", type=Path, default=Path("data/demo"))
    parser.add_argument("--out", type=Path, default=Path("runs/patching"))
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument(
        "--tool", default="npx --yes @playcanvas/splat-transform", help="command that runs splat-transform"
    )
    parser.add_argument("--set", default="personalize.steps=4 distill.iterations=4", help="parameters of `command`")
    parser.add_argument("what", choices=("write", "command", "score"))
    arguments = parser.parse_args()
    if arguments.what == "write":
        write_scenes(arguments.run, arguments.scene, arguments.out)
    elif arguments.what == "command":
        run_patch_command(arguments.run, arguments.out, arguments.runs, shlex.split(arguments.tool), arguments.set)
    else:
        score(arguments.run, arguments.out, arguments.runs)


if __name__ == "__main__":
    main()
