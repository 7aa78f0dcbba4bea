"""Check of the method at the paper's sizes on this GPU: correctness, speed and memory. No part starts after 8 minutes.

- gsplat against the float64 oracle (plain torch): color, depth, alpha, features and their gradients, and the sums of
  blending weights; the same antialiased, and in a crop; SSIM and its gradient.
- One step of each loss at the paper's sizes with the full-size SD2-inpainting: seconds per step (median of three),
  memory allocated and reserved. The weights are the published ones if they are on this machine, else random ones of the
  same shapes.
- A fit at 1600 px: images per second, and whether the fit improves; the hours that the paper's steps would take.

A part that fails reports the reason in a line, and all other parts still run. A JSON file and a table are written after
each part.

    python -m lab.gpu.check --out runs/gpu-check      (--device cpu: the same parts, small, on the CPU)
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
from pathlib import Path
from typing import Any

import torch

from lab.gpu import exact, steps
from lab.gpu.bench import PAPER, TOY, Bench
from reffusion.gaussians.ssim import triton_works
from reffusion.io.machine import detect as facts_of_machine
from reffusion.io.machine import find_missing
from reffusion.params.distill import Params as Distill
from reffusion.params.fit import Params as Fit
from reffusion.params.personalize import Params as Personalize

SECONDS_LIMIT = 480.0  # without gsplat's compilation
# The critic's step comes last, since it is the most likely to run out of memory.
PARTS: dict[str, Callable[[Bench], dict[str, Any]]] = {
    "splatting": exact.check_splatting,
    "splatting, antialiased": lambda bench: exact.check_splatting(bench, antialiased=True),
    "splatting, a crop": lambda bench: exact.check_splatting(bench, crop=True),
    "SSIM": exact.check_similarity,
    "reconstruction": steps.reconstruction,
    "reference": steps.reference,
    "fit": steps.fit_scene,
    "personalization": steps.personalization,
    "SDS": steps.distillation,
    "depth": steps.depth,
    "adversarial": steps.adversarial,
}


def check(device: str, out: Path) -> dict[str, Any]:
    """Run all parts, write gpu_check.json and gpu_check.md after each part, and return the report.

    A failing part does not stop the following parts.

    Args:
        device: "cuda", or "cpu" for the same parts at small sizes.
        out: folder to write to.

    Returns:
        "machine": facts; "parts": name of a part -> result; "projected_hours": see `project_hours`; "seconds": wall
        time of all parts.
    """
    out.mkdir(parents=True, exist_ok=True)
    bench = Bench(PAPER if device == "cuda" else TOY, device, out)
    report: dict[str, Any] = {"machine": describe_machine(device), "parts": {}}
    began = time.perf_counter()
    for name, part in PARTS.items():
        report["parts"][name] = run_part(part, bench, time.perf_counter() - began)
        report["projected_hours"] = project_hours(report["parts"])
        report["seconds"] = time.perf_counter() - began
        write_atomically(out / "gpu_check.json", json.dumps(report, indent=1) + "\n")
        write_atomically(out / "gpu_check.md", table(report))
    return report


def run_part(part: Callable[[Bench], dict[str, Any]], bench: Bench, seconds: float) -> dict[str, Any]:
    """Run a part and return its result, or {"skipped": reason} or {"failed": reason}.

    Args:
        part: the part.
        bench: device and sizes.
        seconds: seconds since the first part began; above `SECONDS_LIMIT` the part is skipped.
    """
    if seconds > SECONDS_LIMIT:
        return {"skipped": f"{SECONDS_LIMIT:.0f} s are over"}
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


def write_atomically(path: Path, text: str) -> None:
    """Write a file atomically: an interruption leaves the old file unchanged."""
    partial = path.with_suffix(path.suffix + ".writing")
    partial.write_text(text)
    os.replace(partial, path)


def project_hours(parts: dict[str, dict[str, Any]]) -> dict[str, float]:
    """Compute the hours that the paper's numbers of steps would take at the measured seconds per step.

    Args:
        parts: name of a part -> result.

    Returns:
        Stage -> hours, for the stages whose parts were all measured.
    """
    seconds = {name: part["seconds"] for name, part in parts.items() if "seconds" in part}
    hours, distill = {}, Distill()
    if "images_per_second" in parts.get("fit", {}):
        hours["fit"] = Fit().iterations / parts["fit"]["images_per_second"] / 3600
    if "personalization" in seconds:
        hours["personalize"] = Personalize().steps * seconds["personalization"] / 3600
    every = {"reconstruction": distill.reconstruction.every, "SDS": 1, "depth": distill.depth.every, "adversarial": 1}
    if every.keys() <= seconds.keys():
        step = sum(seconds[name] / each for name, each in every.items())
        hours["distill"] = distill.iterations * step / 3600
    return hours


def describe_machine(device: str) -> dict[str, Any]:
    """Return facts on the machine: GPU, driver, versions and settings; for device "cpu" only torch's version.

    On a GPU this also loads gsplat's extension before all parts, so that no part's time includes it. If `make gpu` has
    not built the extension, it is built now.
    """
    facts: dict[str, Any] = {"device": device, "torch": torch.__version__}
    if device == "cpu":
        return facts
    began = time.perf_counter()
    from gsplat.cuda import _backend

    properties, tf32 = torch.cuda.get_device_properties(0), (torch.backends.cuda.matmul, torch.backends.cudnn)
    return facts | {
        "device": properties.name,
        "memory_gb": round(properties.total_memory / 1e9, 1),
        "cuda": torch.version.cuda,
        "driver": facts_of_machine().driver,
        "gsplat": importlib.metadata.version("gsplat"),
        "extension": _backend._C is not None,
        "extension_seconds": round(time.perf_counter() - began, 1),
        "triton": triton_works(),
        "tf32_products": tf32[0].allow_tf32,
        "tf32_convolutions": tf32[1].allow_tf32,
    }


def table(report: dict[str, Any]) -> str:
    """Return the report as a Markdown table with a row per part, the machine and the projected hours."""
    rows = ["| what | seconds | peak GB | more |", "| --- | --- | --- | --- |"]
    for name, part in report["parts"].items():
        more = {key: value for key, value in part.items() if key not in ("seconds", "peak_gb")}
        details = ", ".join(f"{key} {_short(value)}" for key, value in more.items())
        rows.append(f"| {name} | {_short(part.get('seconds'))} | {_short(part.get('peak_gb'))} | {details} |")
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
    if options.device == "cuda" and (lacking := find_missing(facts_of_machine())):
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
