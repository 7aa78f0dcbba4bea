"""2D inpainting by any inpainting pipeline of diffusers: Stable Diffusion, SDXL, SD3.5, Flux Fill and others.

A pipeline paints; it is no prior, so neither personalization nor distillation can use it.
"""

from __future__ import annotations

import importlib.util
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from reffusion.params.base import REFINED_FROM
from reffusion.params.inpainter import Inpainter
from reffusion.prior.inpaint import paint_coarse_to_fine, to_input, to_picture
from reffusion.prior.model import find_folder, library_class, load_network, one_line
from reffusion.seeding import generator as seeded
from reffusion.weights import local

# Arguments of a pipeline's call that are used here.
ARGUMENTS = (
    "prompt", "image", "mask_image", "height", "width",
    "strength", "num_inference_steps", "guidance_scale", "generator", "output_type",
)  # fmt: skip
LIBRARIES = ("diffusers", "transformers")  # the libraries of networks; a part of another library is code of the model


def load_painter(
    inpainter: Inpainter, prompt: str, device: str, dtype: str
) -> Callable[[np.ndarray, np.ndarray, int], np.ndarray]:
    """Load a pipeline, and return a function that paints into the hole of a view.

    The whole view is painted at the pipeline's native size, then windows at finer levels (`paint_coarse_to_fine`). On
    CUDA, parts that do not compute wait in the memory of the CPU if the package `accelerate` is installed.

    Args:
        inpainter: the setting, of kind "pipeline".
        prompt: what the hole shows.
        device: the device of the networks.
        dtype: type of the networks, such as "float16".

    Returns:
        Function (image uint8 [H, W, 3], hole bool [H, W], seed) -> uint8 [H, W, 3]. Pixels outside the hole are
        unchanged. The function raises ValueError if the pipeline fails, or if its pictures have another size or are not
        finite.

    Raises:
        ValueError: weights are missing or damaged or do not fit, or diffusers cannot inpaint with this pipeline. The
            message is one line.
    """
    assert inpainter.weights is not None
    pipe = load_pipeline(inpainter.weights, getattr(torch, dtype), device)
    size = native_size(pipe)
    options = {"prompt": prompt, "height": size, "width": size, "output_type": "np"}
    given = {"num_inference_steps": inpainter.steps, "guidance_scale": inpainter.guidance_scale}
    options |= {name: value for name, value in given.items() if value is not None}

    def paint(image: np.ndarray, hole: np.ndarray, seed: int) -> np.ndarray:
        def sample(pictures: Tensor, mask: Tensor, *place: int, start: float, level: int | str) -> Tensor:
            random = seeded(seed, "inpaint", level, *place)
            return _run(pipe, pictures, mask, options | {"strength": start, "generator": random})

        start = inpainter.strength
        finest = min(start, REFINED_FROM)
        (painted,) = paint_coarse_to_fine(
            sample, size, to_input(image), torch.from_numpy(hole), count=1, start=start, finest=finest
        )
        return to_picture(painted)

    return paint


def load_pipeline(source: str, dtype: torch.dtype, device: str) -> Any:
    """Load an inpainting pipeline from a folder, or by a hub id whose weights are on this machine.

    A folder of a text-to-image pipeline is loaded as the inpainting pipeline of the same networks, if there is one.

    Raises:
        ValueError: as `load_painter`.
    """
    folder = find_folder(source)
    index = local.check_pipeline(folder)
    loader = _find_loader(folder, index["_class_name"])
    try:
        pipe = loader(folder, local_files_only=True, use_safetensors=True, **_load_parts(folder, index, dtype))
    except Exception as error:  # the library raises various types
        raise ValueError(f"{source}: diffusers cannot load it for inpainting: {one_line(error)}") from error
    _check_arguments(source, type(pipe))
    pipe.set_progress_bar_config(disable=True)
    if device == "cuda" and importlib.util.find_spec("accelerate"):
        pipe.enable_model_cpu_offload()
        return pipe
    return pipe.to(device)


def _find_loader(folder: Path, name: str) -> Callable[..., Any]:
    """Return the loader of pipeline class `name` for inpainting; raises ValueError if diffusers lacks this class."""
    try:
        kind = library_class(name)
    except AttributeError:
        raise ValueError(
            f"{folder}: this diffusers has no pipeline {name}: `pip install -U diffusers`, or take another model"
        ) from None
    # The table of AutoPipelineForInpainting knows families of models; Flux Fill, which only inpaints, is in no family.
    is_painter = "mask_image" in inspect.signature(kind.__call__).parameters
    return (kind if is_painter else library_class("AutoPipelineForInpainting")).from_pretrained


def _load_parts(folder: Path, index: dict[str, Any], dtype: torch.dtype) -> dict[str, Any]:
    """Load a pipeline's networks: part -> network, None for parts left out; raises ValueError for code of the model."""
    parts = local.pipeline_parts(index)
    loaded = {part: None for part, value in index.items() if isinstance(value, list) and part not in parts}
    for part, (library, name) in parts.items():
        if not list((folder / part).glob("*.safetensors")):
            continue  # tokenizers and schedulers
        if library not in LIBRARIES:
            raise ValueError(f"{folder / part}: {library}.{name} is code that comes with the model, and is not run")
        keyword = "torch_dtype" if library == "diffusers" else "dtype"
        loaded[part] = load_network(library_class(name, library), folder, part, **{keyword: dtype})
    return loaded


def _check_arguments(source: str, kind: type) -> None:
    """Raise ValueError unless a pipeline can be called with `ARGUMENTS` alone."""
    parameters = dict(list(inspect.signature(kind.__call__).parameters.items())[1:])
    missing = [name for name in ARGUMENTS if name not in parameters]
    empty, variable = inspect.Parameter.empty, (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    needed = [n for n, p in parameters.items() if p.default is empty and p.kind not in variable and n not in ARGUMENTS]
    if missing or needed:
        lacks = f"takes no {', '.join(missing)}" if missing else f"also needs {', '.join(needed)}"
        raise ValueError(f"{source}: {kind.__name__} {lacks}, so it cannot paint here: take another pipeline")


def native_size(pipe: Any) -> int:
    """Return the side in pixels of the square pictures on which the networks of a pipeline were trained."""
    network = getattr(pipe, "unet", None) or pipe.transformer
    size = getattr(pipe, "default_sample_size", None) or network.config.sample_size
    return int(pipe.vae_scale_factor * (size if isinstance(size, int) else min(size)))


def _run(pipe: Any, pictures: Tensor, mask: Tensor, options: dict[str, Any]) -> Tensor:
    """Return a picture [1, 3, n, n] in [-1, 1], painted where the mask [1, 1, n, n] is 1; ValueError if this fails."""
    name, size = type(pipe).__name__, pictures.shape[-1]
    image = Image.fromarray(to_picture(pictures[0]))
    hole = Image.fromarray((mask[0, 0] > 0).numpy().astype(np.uint8) * 255)
    try:
        answer = np.asarray(pipe(image=image, mask_image=hole, **options).images)
    except torch.OutOfMemoryError:
        raise ValueError(
            f"{name}: out of memory: take reference.dtype=float16, or a smaller model; with `pip install accelerate` "
            "parts wait in the memory of the CPU"
        ) from None
    except (RuntimeError, ValueError, TypeError) as error:
        raise ValueError(f"{name} failed on a picture of {size}x{size} px: {one_line(error)}") from error
    if answer.shape != (1, size, size, 3) or not np.isfinite(answer).all():
        raise ValueError(f"{name}: its answer to {[1, size, size, 3]} is {list(answer.shape)}, or not finite")
    return torch.from_numpy(answer).permute(0, 3, 1, 2).float() * 2 - 1
