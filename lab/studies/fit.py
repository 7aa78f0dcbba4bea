"""LPIPS and PSNR of held-out views against seconds of fitting: `python -m lab.studies.fit --run runs/demo`.

The study fits the scene of a finished `poses` stage with the laptop profile's parameters and variants of them. Every
8th training view is held out and only measured. Of the other views the worst PSNR is given, and the share of their
blocks of 32 px with less than 18 dB, where a person sees flat color or needles. The seconds do not include the
measurements, but include making the initial points. The study writes fit.png (curves), fit.csv (all measurements) and
fit.md (final values) to --out. Variants whose results are already in --out are not run again; an interrupted fit
continues.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from lab.studies.jobs import profile_params
from reffusion import trace
from reffusion.fit.exposure import load_photos_in_scene_exposure
from reffusion.io.arrays import save_text
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_scene, load_views
from reffusion.metrics import image_metrics, lpips
from reffusion.splat.rasterizer import render
from report import charts, page
from stages import fit

BLOCK, BLOCK_DB = 32, 18.0  # side of a block of a training view in px, and the PSNR below which people see it
VARIANTS = {  # name -> differences from the profile's parameters of `fit`
    "laptop": {},
    "laptop, half the steps": {"iterations": 800},
    "laptop, twice the steps": {"iterations": 3200},
    "laptop, .4 Gaussians a pixel": {"densify.per_pixel": 0.4},
    "fine": {"iterations": 6000, "densify.stop": 0.6, "densify.per_pixel": 2},
    "sparse points only": {"init.flow_cell": 0},
    "antialiased": {"antialiased": True},
    "exposure": {"exposure": "always"},
    "3DGS's rates": {
        "lr.means": 1.6e-4,
        "lr.scales": 5e-3,
        "lr.quats": 1e-3,
        "lr.sh0": 2.5e-3,
        "lr.shN": 1.25e-4,
    },
}


def run_fit(poses: Path, out: Path, params: fit.Params) -> list[dict[str, float]]:
    """Run a fit in the folder `out`, unless it is finished there, and return its trace.

    Args:
        poses: folder of the stage `poses`.
        out: folder of the fit.
        params: parameters of the stage `fit`.

    Raises:
        ValueError: `out` has a fit with other parameters.
    """
    saved, text = out / "params.json", params.model_dump_json()
    if saved.exists() and json.loads(saved.read_text()) != json.loads(text):
        raise ValueError(f"{out} holds a fit with other parameters; remove it, or name another --out")
    out.mkdir(parents=True, exist_ok=True)
    saved.write_text(text)
    if not (out / "gaussians.ply").exists():
        fit.run(params, out, poses=poses)
    return trace.read_trace(out / "trace.jsonl")


def measure_lpips(poses: Path, folder: Path, every: int) -> float:
    """Return the mean LPIPS (vgg) of the held-out views, rendered from the fit in `folder`, over whole views.

    Raises:
        ValueError: the weights of LPIPS are not on this machine.
    """
    scene, gaussians = load_scene(poses), load_ply(folder / "gaussians.ply")
    model, reason = lpips.load("vgg")
    if model is None:
        raise ValueError(reason)
    values = []
    for name, photo in load_views(poses, scene.train[every // 2 :: every]).items():
        target = image_metrics.lpips_targets(photo / np.float32(255), {"vgg": model})["vgg"]
        assert target is not None
        values.append(target.distance(render(gaussians, scene.cameras[name]).color.clamp(0, 1).numpy()))
    return float(np.mean(values))


def measure_training(poses: Path, folder: Path, every: int) -> tuple[float, float]:
    """Return the PSNR of the worst training view, and the mean share of the views' blocks below `BLOCK_DB`.

    The fit in `folder` is compared with photographs of equal exposure.
    """
    scene, gaussians = load_scene(poses), load_ply(folder / "gaussians.ply")
    held_out = scene.train[every // 2 :: every]
    worst, shares = [], []
    photos = load_photos_in_scene_exposure(poses, folder, [n for n in scene.train if n not in held_out])
    for name, photo in photos.items():
        error = render(gaussians, scene.cameras[name]).color.clamp(0, 1).numpy() - photo / np.float32(255)
        squared = np.square(error).mean(2)
        high, wide = (length // BLOCK for length in squared.shape)
        blocks = squared[: high * BLOCK, : wide * BLOCK].reshape(high, BLOCK, wide, BLOCK).mean((1, 3))
        worst.append(trace.decibels(float(squared.mean())))
        shares.append(float(np.mean(blocks > 10 ** (-BLOCK_DB / 10))))
    return min(worst), float(np.mean(shares))


def draw(curves: dict[str, list[dict[str, float]]], title: str, path: Path) -> None:
    """Draw the PSNR of held-out views against seconds from the first second on, one curve per variant.

    Args:
        curves: variant -> lines of its trace.
        title: title of the chart.
        path: PNG to write.
    """
    figure, grid = charts.new_figure(4.2, 1, 1)
    axes = grid[0, 0]
    for name, lines in curves.items():
        late = [line for line in lines if line["seconds"] >= 1]
        axes.plot([p["seconds"] for p in late], [p["psnr_held_out"] for p in late], marker=".", label=name)
    axes.set(xscale="log", xlabel="seconds of fitting", ylabel="PSNR of held-out views (dB)", title=title)
    axes.legend(fontsize=8)
    charts.save_chart(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, required=True, help="runs/<scene>, its stage `poses` finished")
    parser.add_argument("--out", type=Path, help="default: runs/fit/<scene>")
    parser.add_argument("--profile", default="laptop")
    parser.add_argument("--every", type=int, default=8, help="hold out every n-th training view")
    parser.add_argument("--only", nargs="+", choices=list(VARIANTS), help="these variants")
    arguments = parser.parse_args()
    poses, out = arguments.run / "poses", arguments.out or Path("runs/fit") / arguments.run.name
    if not (poses / "receipt.json").exists():
        raise ValueError(f"{poses} is missing: run `make scene={arguments.run.name} poses` first")
    chosen = {
        name: profile_params("fit", arguments.profile, VARIANTS[name] | {"holdout": arguments.every})
        for name in arguments.only or VARIANTS
    }
    curves, perceptual, training = {}, {}, {}
    for name, params in chosen.items():
        folder = out / name.replace(" ", "_").replace(",", "")
        curves[name] = run_fit(poses, folder, params)
        perceptual[name], last = measure_lpips(poses, folder, arguments.every), curves[name][-1]
        training[name] = measure_training(poses, folder, arguments.every)
        print(
            f"{name}: LPIPS {perceptual[name]:.4f}, {last['psnr_held_out']:.2f} dB after {last['seconds']:.0f} s, "
            f"{last['gaussians']} Gaussians; worst training view {training[name][0]:.2f} dB"
        )
    columns = ("seconds", "iteration", "gaussians", "psnr", "psnr_held_out")
    rows = [",".join([name.replace(",", ";"), *(str(p[c]) for c in columns)]) for name in curves for p in curves[name]]
    (out / "fit.csv").write_text("\n".join([",".join(["variant", *columns]), *rows]) + "\n")
    header = ["variant", "seconds", "Gaussians", "held-out LPIPS (vgg)", "held-out PSNR (dB)"]
    header += ["worst training view (dB)", f"blocks under {BLOCK_DB:.0f} dB"]
    cells = []
    for name, lines in curves.items():
        end, (worst, share) = lines[-1], training[name]
        cells.append([name, f"{end['seconds']:.0f}", str(end["gaussians"]), f"{perceptual[name]:.4f}"])
        cells[-1] += [f"{end['psnr_held_out']:.2f}", f"{worst:.2f}", f"{share:.4f}"]
    save_text(out / "fit.md", page.markdown_table(header, cells))
    draw(curves, f"{arguments.run.name}, every {arguments.every}th view held out", out / "fit.png")


if __name__ == "__main__":
    main()
