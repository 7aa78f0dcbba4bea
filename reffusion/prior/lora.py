"""LoRA on UNet and text encoders (RefFusion section 4.1): attach, train, save for diffusers, merge.

This is the only module that imports peft.

A weight with LoRA is W' = W + alpha / rank * B A. Without dropout the product B A is added to the weights once per
forward pass, instead of passing every input through A and B as well. Function and gradients are the same, and a step of
the embedded prior is a fifth cheaper. In half precision this is not done: most of a small product would be lost in the
sum, while A and B themselves are float32.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import MethodType
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from reffusion.prior.model import Prior, library_class, pipeline

LORA_FILE = "pytorch_lora_weights.safetensors"
# Queries, keys, values and output projection.
ATTENTION = ("to_q", "to_k", "to_v", "to_out.0")
TEXT_ATTENTION = ("q_proj", "k_proj", "v_proj", "out_proj")
CONVOLUTIONS = (
    "conv_in", "conv1", "conv2", "conv_shortcut", "conv_out", "proj_in", "proj_out", "ff.net.0.proj",
    "ff.net.2",
)  # fmt: skip


def attach(
    prior: Prior, rank: int, alpha: float, dropout: float, layers: str, seed: int
) -> dict[str, list[nn.Parameter]]:
    """Attach new LoRA layers to UNet and text encoder, for SDXL to both text encoders, in place, with dropout off.

    Args:
        prior: The diffusion prior.
        rank, alpha, dropout: Of every layer. A weight changes by alpha / rank * B A.
        layers: "attention" (as in the paper), or "attention+conv" (also convolutions and feed-forward layers of the
            UNet).
        seed: Seed of the initial values.

    Returns:
        {"unet": parameters, "text": parameters of the text encoders}, float32, requiring gradients.
    """
    from peft import LoraConfig

    targets = ATTENTION + CONVOLUTIONS if layers == "attention+conv" else ATTENTION
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        for label, part in _adapted_parts(prior).items():
            names = targets if label == "unet" else TEXT_ATTENTION
            # peft annotates lora_alpha as int, and only divides it by the rank.
            adapter = LoraConfig(r=rank, lora_alpha=cast(int, alpha), lora_dropout=dropout, target_modules=list(names))
            part.add_adapter(adapter)
    set_dropout(prior, False)
    unet, *texts = map(_lora_parameters, _adapted_parts(prior).values())
    parameters = {"unet": unet, "text": [each for text in texts for each in text]}
    if dropout == 0 and prior.dtype == torch.float32:
        _merge_in_forward(prior.unet)
    return parameters


def _adapted_parts(prior: Prior) -> dict[str, nn.Module]:
    """Return the networks that LoRA adapts by the labels of `state`: the UNet first, then the text encoders."""
    parts = {"unet": prior.unet, "text": prior.text_encoder, "text_2": prior.text_encoder_2}
    return {label: part for label, part in parts.items() if part is not None}


def _merge_in_forward(part: nn.Module) -> None:
    """Make layers with LoRA compute with W' in one product, which takes fewer operations for the same result."""
    from peft.tuners.lora import LoraLayer

    for layer in part.modules():
        if isinstance(layer, LoraLayer):
            layer.forward = MethodType(
                _forward_convolution if isinstance(layer.base_layer, nn.Conv2d) else _forward_linear, layer
            )


def _merged_weight(layer) -> Tensor:
    """Return W' of a peft layer. For a convolution A has the kernel's size, and B is 1 x 1."""
    (name,) = layer.active_adapters
    a, b = layer.lora_A[name].weight, layer.lora_B[name].weight
    weight = layer.base_layer.weight
    return weight + (layer.scaling[name] * (b.flatten(1) @ a.flatten(1)).view_as(weight)).to(weight.dtype)


def _forward_convolution(layer, x: Tensor) -> Tensor:
    base = layer.base_layer
    return F.conv2d(x, _merged_weight(layer), base.bias, base.stride, base.padding, base.dilation, base.groups)


def _forward_linear(layer, x: Tensor) -> Tensor:
    return F.linear(x, _merged_weight(layer), layer.base_layer.bias)


def _lora_parameters(part: nn.Module) -> list[nn.Parameter]:
    parameters = []
    for name, parameter in part.named_parameters():
        if "lora_" in name:
            parameter.data = parameter.data.float()
            parameter.requires_grad_(True)
            parameters.append(parameter)
    return parameters


def state(prior: Prior) -> dict[str, Tensor]:
    """Return copies of the LoRA weights by name, for checkpoints."""
    return {
        f"{label}.{name}": parameter.detach().cpu().clone()
        for label, part in _adapted_parts(prior).items()
        for name, parameter in part.named_parameters()
        if "lora_" in name
    }


def load_state(prior: Prior, state: dict[str, Tensor]) -> None:
    """Restore the weights returned by `state`, into layers attached by `attach`."""
    for label, part in _adapted_parts(prior).items():
        for name, parameter in part.named_parameters():
            if "lora_" in name:
                parameter.data.copy_(state[f"{label}.{name}"])


def set_dropout(prior: Prior, active: bool) -> None:
    """Switch UNet and text encoders to training mode, with LoRA dropout (True), or to evaluation mode (False)."""
    for part in _adapted_parts(prior).values():
        part.train(active)


def save(prior: Prior, folder: Path) -> None:
    """Write the LoRA, with rank and alpha, to `folder` as pytorch_lora_weights.safetensors.

    diffusers reads this file by `load_lora_weights`.
    """
    from peft import get_peft_model_state_dict

    arguments: dict[str, Any] = {}
    for label, part in _adapted_parts(prior).items():
        layers = get_peft_model_state_dict(part, save_embedding_layers=False)
        name = label.replace("text", "text_encoder")
        arguments[f"{name}_lora_layers"] = layers if label == "unet" else _with_prefix(layers)
        arguments[f"{name}_lora_adapter_metadata"] = _adapter_config(part)
    kind = "StableDiffusionXLInpaintPipeline" if prior.text_encoder_2 is not None else "StableDiffusionInpaintPipeline"
    library_class(kind).save_lora_weights(folder, weight_name=LORA_FILE, **arguments)
    _sort_metadata(folder / LORA_FILE)


def _with_prefix(layers: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the text encoder's weights with the prefix "text_model." of published LoRA files in their names."""
    # transformers 5 uses no prefix, but transformers 4 and other readers of such files need it. diffusers removes the
    # prefix if the encoder has none.
    return {key if key.startswith("text_model.") else f"text_model.{key}": value for key, value in layers.items()}


def _sort_metadata(path: Path) -> None:
    """Sort the metadata in the header of a safetensors file."""
    # safetensors writes the metadata in random order. Equal weights must give equal files, else later stages would run
    # again.
    content = path.read_bytes()
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:end])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)  # tensors start at a multiple of 8
    path.write_bytes(len(text).to_bytes(8, "little") + text + content[end:])


def _adapter_config(part: nn.Module) -> dict[str, Any]:
    """Return the configuration of the adapter (rank, alpha, layers), sorted and without local paths."""
    config = next(iter(part.peft_config.values())).to_dict()
    plain = {key: sorted(value) if isinstance(value, set) else value for key, value in sorted(config.items())}
    return plain | {"base_model_name_or_path": None}


def merge(prior: Prior, folder: Path) -> Prior:
    """Return the prior with the LoRA in `folder`.

    The result shares the networks of the given prior, which are changed in place.

    The LoRA is merged into the weights of the UNet. The text encoders keep separate LoRA layers.

    Raises:
        ValueError: The folder contains no LoRA.
    """
    if not (folder / LORA_FILE).exists():
        raise ValueError(f"{folder / LORA_FILE} does not exist; run the personalize stage first")
    pipe = pipeline(prior)
    pipe.load_lora_weights(folder, weight_name=LORA_FILE)
    prior.unet.fuse_lora()
    prior.unet.unload_lora()
    for part in _adapted_parts(prior).values():
        part.requires_grad_(False).eval()
    return replace(prior)
