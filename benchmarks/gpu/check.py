"""Does the production path work on this GPU, how fast, in how much memory? A JSON file and a table, within 8 minutes.

- gsplat against the float64 oracle: colour, depth, alpha, features, weights and their gradients; antialiased, and in a
  crop; SSIM's gradient.
- One step of each loss at the paper's sizes with the full-size SD2-inpainting: its weights where they are on this
  machine, else random ones of the same shapes. Seconds a step (the median of three), memory taken and reserved.
- A fit at 1600 px: images a second, and that it gets better; the hours that the paper's steps would take.

A part that fails says why in a line, and the others go on; the file is written after each.

    python -m benchmarks.gpu.check --out runs/gpu-check      (--device cpu: the same parts, small, on the CPU)
"""

from __future__ import annotations

import argparse
import gc
import importlib.metadata
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
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
from reffusion.gaussians.ssim import dssim, dssim_torch
from reffusion.geometry import Degenerate
from reffusion.io.machine import lacks
from reffusion.io.machine import machine as facts_of_machine
from reffusion.params.distill import Adversarial, Depth, Sds
from reffusion.params.distill import Params as Distill
from reffusion.params.fit import Densify, Params, SphericalHarmonics
from reffusion.params.personalize import Params as Personalize
from reffusion.prior import crops, denoising, diffusion, memory
from reffusion.prior.model import Prior, load_prior, without_text
from reffusion.prior.personalize import train_step
from reffusion.seeding import generator
from reffusion.splat import rasterizer
from reffusion.types import PARAMETERS, Camera, Gaussians
from reffusion.weights import local, published

LIMIT = 480.0  # seconds, gsplat's compilation left out
# Errors of gsplat's formulas in float32, emulated: 4e-7 of the values, 2e-6 of the gradients. Its fast exponential may
# err by 8 units in the last place more, 1e-6. Ten and fifty times that: an error of the method is far above.
VALUES, GRADIENTS = 1e-5, 1e-4
# A contribution that float32 puts on the other side of 1/255 changes a pixel by as much: these are not errors.
FLIPPED = 1e-4  # share of the pixels that may differ by more
COUNTED = 1e-3  # and what they may change of the numbers of blended pixels


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
    shape: full_size.Shape
    oracle: tuple[int, int] = (400, 200)  # Gaussians and width of what is compared with the oracle


PAPER = Sizes(1280, 500_000, 16, 400, 12, 3, Adversarial(), full_size.SD2)  # 1600 x 1280 px
TOY = Sizes(40, 300, 2, 4, 3, 1, Adversarial(patches=8, size=8, width=8), full_size.shrunk(full_size.SD2), (100, 70))


@dataclass
class Bench:
    """Where the parts work, and the prior that the last of them left: two in a row may need the same.

    Attributes:
        device: "cuda" or "cpu". out: a folder for what a part writes.
    """

    sizes: Sizes
    device: str
    out: Path
    _prior: tuple[str, Prior, str] | None = field(default=None, repr=False)

    def prior(self, half: str) -> tuple[Prior, str]:
        """Of that precision on a GPU, else float32; the published weights where they are here, else random ones."""
        if self._prior is None or self._prior[0] != half:
            self._prior = None
            gc.collect()
            dtype, shape = getattr(torch, half if self.device == "cuda" else "float32"), self.sizes.shape
            if shape == full_size.SD2 and local.locate(published.SD2) is not None:
                self._prior = half, load_prior(published.SD2, self.device, dtype), published.SD2
            else:
                self._prior = half, full_size.build(shape, dtype, self.device), "random"
        return self._prior[1], self._prior[2]

    def forget_prior(self) -> None:
        self._prior = None

    def scene(self) -> tuple[Gaussians, Tensor]:
        """Gaussians that fill the view, and labels."""
        made = full_size.gaussians(self.sizes.gaussians, self.device)
        masked = torch.rand(len(made), generator=generator(0, "labels")) < 0.1
        return made, masked.to(self.device)

    def measured(self, work: Callable[[], dict[str, float] | None]) -> dict[str, Any]:
        """Seconds (median, after a run to warm up), peak of the GPU (or of living tensors), what `work` says."""
        said, seconds = work() or {}, []
        for _ in range(self.sizes.repeats):
            self._wait()
            began = time.perf_counter()
            work()
            self._wait()
            seconds.append(time.perf_counter() - began)
        peak = memory.peak_bytes(work, self.device)
        found = {"seconds": float(np.median(seconds)), "peak_gb": peak / 1e9}
        if self.device == "cuda":
            found["peak_gb"] += torch.cuda.memory_allocated() / 1e9
            found["reserved_gb"] = torch.cuda.max_memory_reserved() / 1e9
        return found | said

    def _wait(self) -> None:
        if self.device == "cuda":
            torch.cuda.synchronize()


# --------------------------------------------------------------------------------------------------- against the oracle


def drawn(bench: Bench, scene: Gaussians, camera: Camera, impl: str, dtype: torch.dtype) -> dict[str, Tensor]:
    """What one implementation makes of a scene: pictures, sums of weights, the gradients of a sum over all of it."""
    device = "cpu" if impl == "reference" else bench.device
    place = lambda tensor: tensor.detach().to(device, dtype).clone().requires_grad_()
    leaf = scene.map(place)
    draw = generator(0, "pull")
    random = lambda *shape: torch.rand(*shape, generator=draw).to(device, dtype)
    features, background = place(random(len(scene), 3)), place(torch.tensor([0.2, 0.3, 0.4]))
    probe = place(torch.zeros(len(scene), 2))
    picture = rasterizer.render(leaf, camera, features=features, background=background, probe=probe, impl=impl)
    shown = {name: getattr(picture, name) for name in ("color", "depth", "alpha", "features")}
    loss = sum((image * random(*image.shape)).sum() for image in shown.values())
    names = (*PARAMETERS, "features", "background", "probe")
    leaves = (*(getattr(leaf, name) for name in PARAMETERS), features, background, probe)
    slopes = torch.autograd.grad(loss, leaves)
    found = {name: image.detach() for name, image in shown.items()}
    found |= {f"gradient of {name}": slope for name, slope in zip(names, slopes, strict=True)}
    values, still = random(camera.height, camera.width, 2), leaf.map(Tensor.detach)
    found["weights"] = rasterizer.accumulate(still, camera, values, impl=impl)
    found["counts"] = rasterizer.accumulate(still, camera, torch.ones_like(values), impl=impl, count=True)
    return {name: tensor.cpu().double() for name, tensor in found.items()}


def compared(found: dict[str, Tensor], truth: dict[str, Tensor]) -> dict[str, Any]:
    """Relative errors: of pictures that which only `FLIPPED` of the numbers exceed, over the largest; else by norm."""
    errors, limits = {}, {}
    for name, true in truth.items():
        difference = (found[name] - true).abs()
        if name in ("color", "depth", "alpha", "features"):
            nearly_all = difference.flatten().sort().values[int((1 - FLIPPED) * (difference.numel() - 1))]
            errors[name], limits[name] = float(nearly_all / true.abs().max().clamp_min(1e-12)), VALUES
        else:
            errors[name] = float(difference.norm() / true.norm().clamp_min(1e-12))
            limits[name] = COUNTED if name == "counts" else GRADIENTS
    beyond = [name for name, error in errors.items() if not error <= limits[name]]
    return {"errors": errors, "ok": not beyond} | ({"beyond": ", ".join(beyond)} if beyond else {})


def splatting(bench: Bench, antialiased: bool = False, crop: bool = False) -> dict[str, Any]:
    count, width = bench.sizes.oracle
    height = width * 4 // 5
    camera = Camera("oracle", width, height, width, width, width / 2, height / 2, np.eye(4))
    camera = camera.cropped(width // 3, height // 4, width // 3, height // 3) if crop else camera
    scene = replace(full_size.gaussians(count, "cpu").map(Tensor.detach), antialiased=antialiased)
    impl = "cuda" if bench.device == "cuda" else "cpu"
    found = drawn(bench, scene, camera, impl, torch.float32)
    return compared(found, drawn(bench, scene, camera, "reference", torch.float64))


def similarity(bench: Bench) -> dict[str, Any]:
    """D-SSIM and its gradient in float32 on the device against float64: TF32 would be off by a tenth."""
    draw, size = generator(0, "ssim"), bench.sizes.oracle[1]
    image, other = (torch.rand(size, size, 3, generator=draw, dtype=torch.float64) for _ in range(2))
    image, other = 0.5 + 0.1 * image, 0.5 + 0.1 * other  # little contrast: most is lost in the subtraction
    weights = torch.rand(size, size, generator=draw, dtype=torch.float64) > 0.3

    def told(loss, dtype: torch.dtype, device: str) -> dict[str, Tensor]:
        leaf = image.to(device, dtype).requires_grad_()
        value = loss(leaf, other.to(device, dtype), weights.to(device, dtype))
        (slope,) = torch.autograd.grad(value, leaf)
        return {"value": value.detach().cpu().double(), "gradient": slope.cpu().double()}

    return compared(told(dssim, torch.float32, bench.device), told(dssim_torch, torch.float64, "cpu"))


# ----------------------------------------------------------------------------------------------------------- the losses


def term(scene: Gaussians, loss: Tensor) -> None:
    """The way back, and nothing kept of it."""
    loss.backward()
    for name in PARAMETERS:
        getattr(scene, name).grad = None


def reconstruction(bench: Bench) -> dict[str, Any]:
    (scene, masked), view = bench.scene(), full_size.train_view(bench.sizes.rows, bench.device)
    return bench.measured(lambda: term(scene, reconstruction_term(scene, masked, view)[0]))


def reference(bench: Bench) -> dict[str, Any]:
    (scene, masked), view = bench.scene(), full_size.train_view(bench.sizes.rows, bench.device)
    return bench.measured(lambda: term(scene, reference_term(scene, masked, view.camera, view.photo, view.repaint)[0]))


def personalization(bench: Bench) -> dict[str, Any]:
    """Steps of the paper's LoRA, as many samples at once as fit into 20 GB."""
    prior, source = bench.prior("bfloat16")
    picture = full_size.reference(prior.native_size)
    trained, optimizer, training = full_size.trainer(prior, bench.sizes.batch)
    prior = memory.fitted(prior, 20.0, "personalize.memory_gb", lambda p: denoising.one_sample(p, [picture], 0))
    said = bench.measured(lambda: {"loss": train_step(prior, optimizer, [picture], training, 0)})
    moved = sum(float(p.detach().abs().sum()) for p in trained["text"])
    bench.forget_prior()  # it carries LoRA
    return said | {"batch": bench.sizes.batch, "rows": prior.rows_graded, "lora_text": moved, "weights": source}


def prompted(bench: Bench) -> tuple[Prior, Tensor, str]:
    """The prior without its text encoder, the embedded prompts, and where the weights are from."""
    prior, source = bench.prior("float16")
    with torch.no_grad():
        return without_text(prior), diffusion.embed_text(prior, list(crops.PROMPTS)), source


def distillation(bench: Bench) -> dict[str, Any]:
    prior, text, source = prompted(bench)
    (scene, _), view = bench.scene(), full_size.train_view(bench.sizes.rows, bench.device)

    def step() -> dict[str, float]:
        said = full_size.sds_step(prior, text, view, scene, Sds())
        for name in PARAMETERS:
            getattr(scene, name).grad = None
        return said

    return bench.measured(step) | {"weights": source}


def depth(bench: Bench) -> dict[str, Any]:
    prior, text, source = prompted(bench)
    (scene, masked), view = bench.scene(), full_size.train_view(bench.sizes.rows, bench.device)
    estimator, whose = depth_estimator(bench.sizes, bench.device)

    def step() -> dict[str, float]:
        draw = generator(0, "depth")
        loss, _ = depth_term(scene, masked, view, prior, text, Depth(), Sds().guidance, draw, estimator)
        term(scene, loss)
        return {"loss": float(loss.detach())}

    return bench.measured(step) | {"weights": f"{source}, {whose}"}


def adversarial(bench: Bench) -> dict[str, Any]:
    bench.forget_prior()
    (scene, masked), view = bench.scene(), full_size.train_view(bench.sizes.rows, bench.device)
    critic = Adversary(bench.sizes.critic, 0, bench.device)

    def step() -> dict[str, float]:
        draw = generator(0, "patches")
        loss, _, said = adversarial_term(scene, masked, view, view.photo, view.repaint, critic, draw)
        term(scene, loss)
        return said

    return bench.measured(step)


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


# -------------------------------------------------------------------------------------------------------------- the fit


def fitted_scene(bench: Bench) -> dict[str, Any]:
    """A cloud of coloured Gaussians photographed by the splatting itself, fitted from blurred and shifted ones."""
    sizes, device, out = bench.sizes, bench.device, bench.out
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

# The critic's step is the one that is most likely to run out of memory: after all that must not be lost with it.
PARTS: dict[str, Callable[[Bench], dict[str, Any]]] = {
    "splatting": splatting,
    "splatting, antialiased": lambda bench: splatting(bench, antialiased=True),
    "splatting, a crop": lambda bench: splatting(bench, crop=True),
    "SSIM": similarity,
    "reconstruction": reconstruction,
    "reference": reference,
    "fit": fitted_scene,
    "personalization": personalization,
    "SDS": distillation,
    "depth": depth,
    "adversarial": adversarial,
}


def check(device: str, out: Path) -> dict[str, Any]:
    """All of it; what fails says why and does not stop the rest. On the CPU small."""
    out.mkdir(parents=True, exist_ok=True)
    bench = Bench(PAPER if device == "cuda" else TOY, device, out)
    report: dict[str, Any] = {"machine": machine(device), "parts": {}}
    began = time.perf_counter()
    for name, part in PARTS.items():
        report["parts"][name] = result_of(part, bench, time.perf_counter() - began)
        report["projected_hours"] = projected(report["parts"])
        report["seconds"] = time.perf_counter() - began
        write(out / "gpu_check.json", json.dumps(report, indent=1) + "\n")
        write(out / "gpu_check.md", table(report))
    return report


def result_of(part: Callable[[Bench], dict[str, Any]], bench: Bench, seconds: float) -> dict[str, Any]:
    if seconds > LIMIT:
        return {"skipped": f"{LIMIT:.0f} s are over"}
    try:
        return part(bench)
    except Exception as error:
        bench.forget_prior()
        return {"failed": f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"}
    finally:
        gc.collect()
        if bench.device == "cuda":
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats()


def write(path: Path, text: str) -> None:
    """At once or not at all."""
    partial = path.with_suffix(path.suffix + ".writing")
    partial.write_text(text)
    os.replace(partial, path)


def projected(parts: dict[str, dict[str, Any]]) -> dict[str, float]:
    """Hours that the paper's steps take at these seconds a step; of stages all of whose terms were measured."""
    seconds = {name: part["seconds"] for name, part in parts.items() if "seconds" in part}
    hours, distill = {}, Distill()
    if "images_per_second" in parts.get("fit", {}):
        hours["fit"] = Params().iterations / parts["fit"]["images_per_second"] / 3600
    if "personalization" in seconds:
        hours["personalize"] = Personalize().steps * seconds["personalization"] / 3600
    every = {"reconstruction": distill.reconstruction.every, "SDS": 1, "depth": distill.depth.every, "adversarial": 1}
    if every.keys() <= seconds.keys():
        step = sum(seconds[name] / each for name, each in every.items())
        hours["distill"] = distill.iterations * step / 3600
    return hours


def machine(device: str) -> dict[str, Any]:
    """What the figures hold for. Loads gsplat's extension, builds it where `make gpu` has not: outside all parts."""
    said: dict[str, Any] = {"device": device, "torch": torch.__version__}
    if device == "cpu":
        return said
    began = time.perf_counter()
    from gsplat.cuda import _backend

    facts, tf32 = torch.cuda.get_device_properties(0), (torch.backends.cuda.matmul, torch.backends.cudnn)
    return said | {
        "device": facts.name,
        "memory_gb": round(facts.total_memory / 1e9, 1),
        "cuda": torch.version.cuda,
        "driver": facts_of_machine().driver,
        "gsplat": importlib.metadata.version("gsplat"),
        "extension": _backend._C is not None,
        "extension_seconds": round(time.perf_counter() - began, 1),
        "tf32_products": tf32[0].allow_tf32,
        "tf32_convolutions": tf32[1].allow_tf32,
    }


def table(report: dict[str, Any]) -> str:
    """The report for people, in Markdown: a row for each part."""
    rows = ["| what | seconds | peak GB | more |", "| --- | --- | --- | --- |"]
    for name, part in report["parts"].items():
        more = {key: value for key, value in part.items() if key not in ("seconds", "peak_gb")}
        said = ", ".join(f"{key} {_short(value)}" for key, value in more.items())
        rows.append(f"| {name} | {_short(part.get('seconds'))} | {_short(part.get('peak_gb'))} | {said} |")
    facts = ", ".join(f"{key} {value}" for key, value in report["machine"].items())
    hours = _short(report["projected_hours"]) or "not all measured"
    last = f"Hours at the paper's steps: {hours}."
    return "\n".join([f"gpu-check: {facts}; {report['seconds']:.0f} s in all", "", *rows, "", last, ""])


def _short(value: Any) -> str:
    if isinstance(value, dict):
        return "; ".join(f"{k} {_short(v)}" for k, v in value.items())
    return "" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/gpu-check"))
    parser.add_argument("--device", choices=["cuda", "cpu"], default="cuda", help="cpu: the same code, small")
    options = parser.parse_args()
    if options.device == "cuda" and not torch.cuda.is_available():
        print("gpu-check needs a CUDA GPU, and torch finds none on this machine.", file=sys.stderr)
        return 2
    if options.device == "cuda" and (lacking := lacks(facts_of_machine())):
        print(f"error: {'; '.join(lacking)}", file=sys.stderr)
        return 2
    report = check(options.device, options.out)
    print((options.out / "gpu_check.md").read_text())
    bad = [name for name, part in report["parts"].items() if "failed" in part or part.get("ok") is False]
    if bad:
        print(f"error: {', '.join(bad)}: see {options.out / 'gpu_check.json'}", file=sys.stderr)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
