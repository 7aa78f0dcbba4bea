"""Does the production path work on this GPU, how fast, in how much memory? A JSON file and a table, within 8 minutes.

- gsplat against the float64 oracle: values and gradients.
- One step of each loss at the paper's sizes with the full-size SD2-inpainting: its weights where they are on this
  machine, else random ones of the same shapes. Seconds a step (the median of three) and peak memory.
- A fit at 1600 px: images a second, and that it gets better.

    python -m benchmarks.gpu.check --out runs/gpu-check      (--toy: all but gsplat, small, on the CPU)
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.gpu import full_size
from reffusion import trace
from reffusion.depth import monocular
from reffusion.depth.behind import Completion, Seen
from reffusion.distill.adversary import Adversary
from reffusion.distill.confinement import adversarial_term, reconstruction_term, reference_term
from reffusion.distill.depth_term import Estimator, by_network, depth_term
from reffusion.fit.reconstruction import fit
from reffusion.geometry import Degenerate
from reffusion.params.distill import Adversarial, Depth, Sds
from reffusion.params.fit import Densify, Params, SphericalHarmonics
from reffusion.prior import crops, denoising, diffusion, memory
from reffusion.prior.model import Prior, load_prior, without_text
from reffusion.prior.personalize import train_step
from reffusion.seeding import generator
from reffusion.splat import rasterizer
from reffusion.types import PARAMETERS, Camera, Gaussians
from reffusion.weights import local, published

LIMIT = 480.0  # seconds
VALUES, GRADIENTS = 2e-3, 1e-2  # most a pixel may differ from the oracle, and a gradient relative to its norm


@dataclass(frozen=True)
class Sizes:
    """Of what is measured: rows of a view (a quarter wider), Gaussians, samples, steps and views of the fit."""

    rows: int
    gaussians: int
    batch: int
    fit_steps: int
    views: int
    repeats: int
    critic: Adversarial


PAPER = Sizes(1280, 500_000, batch=16, fit_steps=400, views=12, repeats=3, critic=Adversarial())  # 1600 x 1280 px
TOY = Sizes(40, 300, batch=2, fit_steps=4, views=3, repeats=1, critic=Adversarial(patches=8, size=8, width=8))


def measured(work: Callable[[], dict[str, float] | None], device: str, repeats: int) -> dict[str, float]:
    """Seconds (median, after a run to warm up), peak of the GPU (or of living tensors), what `work` says."""
    said, seconds = work() or {}, []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        if device == "cuda":
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - began)
    peak = memory.peak_bytes(work, device)
    resident = torch.cuda.memory_allocated() if device == "cuda" else 0
    return {"seconds": float(np.median(seconds)), "peak_gb": (peak + resident) / 1e9, **said}


# --------------------------------------------------------------------------------------------------- against the oracle


def against_oracle(count: int = 400, width: int = 200) -> dict[str, Any]:
    """The largest difference of a pixel, and of each parameter's gradient relative to its norm, gsplat - reference."""
    height = width * 4 // 5
    camera = Camera("oracle", width, height, width, width, width / 2, height / 2, np.eye(4))
    scene = full_size.gaussians(count, "cpu").map(Tensor.detach)
    pull = torch.rand(height, width, 3, generator=generator(0, "pull"))

    def drawn(gaussians: Gaussians, impl: str) -> tuple[Tensor, dict[str, Tensor]]:
        leaf = gaussians.map(lambda p: p.clone().requires_grad_(True))
        picture = rasterizer.render(leaf, camera, impl=impl).color
        (picture * pull.to(picture)).sum().backward()
        return picture.detach().cpu().double(), {n: getattr(leaf, n).grad.cpu().double() for n in PARAMETERS}

    picture, gradients = drawn(scene.map(Tensor.cuda), "cuda")
    truth, true = drawn(scene.map(Tensor.double), "reference")
    worst = {n: float((gradients[n] - true[n]).norm() / true[n].norm().clamp_min(1e-12)) for n in PARAMETERS}
    values = float((picture - truth).abs().max())
    return {"values": values, "gradients": worst, "ok": values < VALUES and max(worst.values()) < GRADIENTS}


# ----------------------------------------------------------------------------------------------------------- the losses


def losses(shape: full_size.Shape, sizes: Sizes, device: str, out: Path) -> dict[str, dict[str, Any]]:
    """Each term alone: forward and backward."""
    half = device == "cuda"
    view, scene = full_size.train_view(sizes.rows, device), full_size.gaussians(sizes.gaussians, device)
    masked = torch.rand(len(scene), generator=generator(0, "labels")) < 0.1
    masked = masked.to(device)

    def term(loss: Tensor) -> None:
        loss.backward()
        for name in PARAMETERS:
            getattr(scene, name).grad = None

    found = {
        "reconstruction": measured(lambda: term(reconstruction_term(scene, masked, view)[0]), device, sizes.repeats),
        "reference": measured(
            lambda: term(reference_term(scene, masked, view.camera, view.photo, view.repaint)[0]),
            device,
            sizes.repeats,
        ),
    }
    critic = Adversary(sizes.critic, 0, device)

    def judged() -> dict[str, float]:
        loss, _, said = adversarial_term(scene, masked, view, view.photo, view.repaint, critic, generator(0, "patches"))
        term(loss)
        return said

    found["adversarial"] = measured(judged, device, sizes.repeats)
    prior, source = ready(shape, device, torch.float16 if half else torch.float32)
    with torch.no_grad():
        text = diffusion.embed_text(prior, list(crops.PROMPTS))
    prior = without_text(prior)

    def distilled() -> dict[str, float]:
        said = full_size.sds_step(prior, text, view, scene, Sds())
        for name in PARAMETERS:
            getattr(scene, name).grad = None
        return said

    found["SDS"] = measured(distilled, device, sizes.repeats) | {"weights": source}
    estimator, whose = depth_estimator(sizes, device)

    def depths() -> dict[str, float]:
        chosen, draw = Depth(), generator(0, "depth")
        loss, _ = depth_term(scene, masked, view, prior, text, chosen, Sds().guidance, draw, estimator)
        term(loss)
        return {"loss": float(loss.detach())}

    found["depth"] = measured(depths, device, sizes.repeats) | {"weights": f"{source}, {whose}"}
    del prior
    if half:
        torch.cuda.empty_cache()
    prior, source = ready(shape, device, torch.bfloat16 if half else torch.float32)
    found["personalization"] = personalization(prior, sizes, device, out) | {"weights": source}
    return found


def depth_estimator(sizes: Sizes, device: str) -> tuple[Estimator, str]:
    """Depth Anything V2 Small, published or with random weights, of which the sign that fits the scene is taken."""
    from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config

    if sizes == PAPER and local.locate(published.DEPTH_ANYTHING) is not None:
        network, source = monocular.load_network(published.DEPTH_ANYTHING, device), published.DEPTH_ANYTHING
    else:
        backbone = Dinov2Config(
            hidden_size=384, num_hidden_layers=12, num_attention_heads=6, image_size=518 if sizes == PAPER else 56,
            patch_size=14, out_features=["stage3", "stage6", "stage9", "stage12"], reshape_hidden_states=False,
        )  # fmt: skip
        torch.manual_seed(0)
        model = DepthAnythingForDepthEstimation(DepthAnythingConfig(
            backbone_config=backbone, reassemble_hidden_size=384, neck_hidden_sizes=[48, 96, 192, 384],
            fusion_hidden_size=64, head_hidden_size=32, initializer_range=0.1,
        ))  # fmt: skip
        network, source = monocular.make_network(model, device), "random"
    tries = [by_network(lambda image, sign=sign: sign * monocular.disparity(network, image), Completion())
             for sign in (1, -1)]  # fmt: skip

    def disparity(view: Seen, picture: Callable[[], np.ndarray]) -> np.ndarray:
        painted = picture()
        try:
            return tries[0].disparity(view, lambda: painted)
        except Degenerate:
            return tries[1].disparity(view, lambda: painted)

    return Estimator(tries[0].how, disparity), source


def ready(shape: full_size.Shape, device: str, dtype: torch.dtype) -> tuple[Prior, str]:
    """The published weights where they are here and of this shape, else random ones."""
    if shape == full_size.SD2 and local.locate(published.SD2) is not None:
        return load_prior(published.SD2, device, dtype), published.SD2
    return full_size.build(shape, dtype, device), "random"


def personalization(prior: Prior, sizes: Sizes, device: str, out: Path) -> dict[str, Any]:
    """Steps of the paper's LoRA, as many samples at once as fit into 20 GB."""
    picture = full_size.reference(prior.native_size)
    trained, optimizer, training = full_size.trainer(prior, sizes.batch)
    prior = memory.fitted(prior, 20.0, "personalize.memory_gb", lambda p: denoising.one_sample(p, [picture], 0))
    step = lambda: {"loss": train_step(prior, optimizer, [picture], training, 0)}
    said = measured(step, device, sizes.repeats)
    moved = sum(float(p.detach().abs().sum()) for p in trained["text"])
    return said | {"batch": sizes.batch, "rows_in_one_pass": prior.rows_graded, "lora_text": moved}


# -------------------------------------------------------------------------------------------------------------- the fit


def fitted_scene(sizes: Sizes, device: str, out: Path) -> dict[str, Any]:
    """A cloud of coloured Gaussians photographed by the splatting itself, fitted from blurred and shifted ones."""
    truth = full_size.gaussians(sizes.gaussians, device, degree=1).map(Tensor.detach)
    cameras, images = [], {}
    for k in range(sizes.views):
        base, pose = full_size.train_view(sizes.rows, "cpu").camera, np.eye(4)
        pose[0, 3] = 0.3 * (k / max(sizes.views - 1, 1) - 0.5)
        camera = Camera(f"v{k}", base.width, base.height, base.fx, base.fy, base.cx, base.cy, pose)
        with torch.no_grad():
            color = rasterizer.render(truth, camera).color.clamp(0, 1)
        cameras.append(camera)
        images[camera.name] = (color * 255).round().to(torch.uint8).cpu().numpy()
    noise = torch.randn(truth.means.shape, generator=generator(0, "start")).to(device)
    start = truth.map(lambda p: p.clone())
    start.means.add_(0.003 * noise)
    start.sh.mul_(0.5)

    def psnr(gaussians: Gaussians) -> float:
        with torch.no_grad():
            color = rasterizer.render(gaussians, cameras[0]).color.clamp(0, 1).cpu()
        error = (color - torch.from_numpy(images[cameras[0].name]) / 255).square().mean()
        return float(-10 * error.log10())

    before = psnr(start)
    densify, sh = Densify(stop=0.0, cap_max=2 * sizes.gaussians), SphericalHarmonics(degree=1)
    settings = Params(iterations=sizes.fit_steps, sh=sh, densify=densify)
    trace.clear_checkpoint(out)  # of a check that was stopped
    began = time.perf_counter()
    after = psnr(fit(cameras, images, start, settings, folder=out))
    seconds = time.perf_counter() - began
    trace.clear_checkpoint(out)
    size = f"{cameras[0].width}x{cameras[0].height}"
    rate = sizes.fit_steps / seconds
    return {"size": size, "images_per_second": rate, "psnr_before": before, "psnr_after": after, "ok": after > before}


# ---------------------------------------------------------------------------------------------------------------- main


def check(toy: bool, out: Path) -> dict[str, Any]:
    """All of it; what fails says why and does not stop the rest."""
    device, sizes = ("cpu", TOY) if toy else ("cuda", PAPER)
    shape = full_size.shrunk(full_size.SD2) if toy else full_size.SD2
    out.mkdir(parents=True, exist_ok=True)
    began, report = time.perf_counter(), {"machine": machine(device), "toy": toy}
    parts: dict[str, Callable[[], dict[str, Any]]] = {
        "gsplat against the oracle": against_oracle,
        "losses": lambda: losses(shape, sizes, device, out),
        "fit": lambda: fitted_scene(sizes, device, out),
    }
    for name, part in parts.items():
        if toy and part is against_oracle:
            report[name] = {"skipped": "gsplat runs on CUDA only"}
            continue
        if time.perf_counter() - began > LIMIT:
            report[name] = {"skipped": f"{LIMIT:.0f} s are over"}
            continue
        try:
            report[name] = part()
        except Exception as error:
            report[name] = {"failed": f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"}
    report["seconds"] = time.perf_counter() - began
    (out / "gpu_check.json").write_text(json.dumps(report, indent=1) + "\n")
    (out / "gpu_check.md").write_text(table(report))
    return report


def machine(device: str) -> dict[str, Any]:
    if device == "cpu":
        return {"device": "cpu", "torch": torch.__version__}
    facts = torch.cuda.get_device_properties(0)
    memory_gb = round(facts.total_memory / 1e9, 1)
    return {"device": facts.name, "memory_gb": memory_gb, "torch": torch.__version__, "cuda": torch.version.cuda}


def table(report: dict[str, Any]) -> str:
    """The report for people, in Markdown: a row for each measurement."""
    rows = ["| what | seconds | peak GB | more |", "| --- | --- | --- | --- |"]
    parts = {name: part for name, part in report.items() if isinstance(part, dict) and name != "machine"}
    for name, part in parts.items():
        nested = part if all(isinstance(value, dict) for value in part.values()) else {name: part}
        for what, line in nested.items():
            more = {k: v for k, v in line.items() if k not in ("seconds", "peak_gb")}
            said = ", ".join(f"{k} {_short(v)}" for k, v in more.items())
            rows.append(f"| {what} | {_short(line.get('seconds'))} | {_short(line.get('peak_gb'))} | {said} |")
    facts = ", ".join(f"{k} {v}" for k, v in report["machine"].items())
    return "\n".join([f"gpu-check: {facts}; {report['seconds']:.0f} s in all", "", *rows, ""])


def _short(value: Any) -> str:
    if isinstance(value, dict):
        return "; ".join(f"{k} {_short(v)}" for k, v in value.items())
    return "" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/gpu-check"))
    parser.add_argument("--toy", action="store_true", help="the same code, small, on the CPU, without gsplat")
    options = parser.parse_args()
    if not options.toy and not torch.cuda.is_available():
        print("gpu-check needs a CUDA GPU, and torch finds none on this machine.", file=sys.stderr)
        return 2
    report = check(options.toy, options.out)
    print((options.out / "gpu_check.md").read_text())
    bad = [n for n, part in report.items() if isinstance(part, dict) and ("failed" in part or part.get("ok") is False)]
    if bad:
        print(f"error: {', '.join(bad)}: see {options.out / 'gpu_check.json'}", file=sys.stderr)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
