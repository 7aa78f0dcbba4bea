"""Loading of a scene's prior before and after personalization, and the command line of studies that compare the two."""

from __future__ import annotations

import argparse
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from reffusion.io.arrays import load_json, save_json
from reffusion.prior import lora
from reffusion.prior.model import Prior, load_prior
from report import cli

DTYPES = ("float32", "float16", "bfloat16")


def study_parser(about: str, needs: str, folder: str) -> argparse.ArgumentParser:
    """Return the command-line parser of a study that compares a prior before and after personalization.

    Args:
        about: help text.
        needs: stages that the run must have finished, in words.
        folder: name of the default folder for results, inside the run's folder.
    """
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, required=True, help=f"runs/<scene>, with {needs}")
    parser.add_argument("--out", type=Path, help=f"default: runs/<scene>/{folder}")
    parser.add_argument("--prior", help="the prior that was personalized; default: the one in personalize's receipt")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--dtype", choices=DTYPES, default="float32", help="of the UNet and the text encoder")
    return parser


def run_study(study: Callable[[], None]) -> None:
    """Run a study as a command; a ValueError ends the command with its message in one line."""
    cli.command(study)()


def load_priors(arguments: argparse.Namespace) -> tuple[dict[str, Prior], str]:
    """Load the prior of a run before and after personalization.

    Args:
        arguments: result of the parser of `study_parser`.

    Returns:
        {"before": prior, "after": prior}, and the prior's name.

    Raises:
        ValueError: the run has no personalized prior, the device is not available, or the dtype does not fit the
        device.
    """
    adapted: Path = arguments.run / "personalize"
    if not adapted.is_dir():
        make = f"make scene={arguments.run.name} personalize set=distill.sds.run=always"
        raise ValueError(f"{adapted} is missing: run `{make}` first")
    if arguments.device == "cuda" and not torch.cuda.is_available():
        raise ValueError("device=cuda: torch finds no CUDA device here; device=cpu")
    if arguments.device == "cpu" and arguments.dtype == "float16":
        raise ValueError("dtype=float16 is for device=cuda; on the CPU float32 or bfloat16")
    base = arguments.prior or load_json(adapted / "receipt.json")["params"]["prior"]
    fresh = lambda: load_prior(base, arguments.device, getattr(torch, arguments.dtype))
    return {"before": fresh(), "after": lora.merge(fresh(), adapted)}, base


def peak_mb(device: str) -> int:
    """Return the peak memory so far in MB, weights included.

    Args:
        device: "cuda" for the GPU memory that torch allocated, "cpu" for the memory of this process.
    """
    if device == "cuda":
        return round(torch.cuda.max_memory_allocated() / 1e6)
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6)


def save_results(arguments: argparse.Namespace, folder: Path, name: str, results: dict[str, Any]) -> None:
    """Save a study's results as JSON in `folder`/`name`, with device, dtype and peak memory so far.

    These three are also printed.
    """
    peak = peak_mb(arguments.device)
    save_json(folder / name, results | {"device": arguments.device, "dtype": arguments.dtype, "peak_mb": peak})
    print(f"on {arguments.device} in {arguments.dtype}, both priors loaded: at most {peak:,} MB")
