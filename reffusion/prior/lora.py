"""LoRA on UNet and text encoder (RefFusion section 4.1): attach, train, save for diffusers, merge.

The only importer of peft.

W' = W + alpha / rank * B A. Without dropout the product is added to the weights once a forward pass, instead of running
every input through A and B too: the same function and gradients, a fifth of a step cheaper for the embedded prior.
Not in half precision: there most of a small product would be lost in the sum, while beside it A and B are float32.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import MethodType
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from reffusion.prior.model import Prior, pipeline, pipeline_class

LORA_FILE = "pytorch_lora_weights.safetensors"
# Queries, keys, values; the last of either is the output projection.
ATTENTION = ("to_q", "to_k", "to_v", "to_out.0")
TEXT_ATTENTION = ("q_proj", "k_proj", "v_proj", "out_proj")
CONVOLUTIONS = (
    "conv_in",
    "conv1",
    "conv2",
    "conv_shortcut",
    "conv_out",
    "proj_in",
    "proj_out",
    "ff.net.0.proj",
    "ff.net.2",
)


def add(prior: Prior, rank: int, alpha: float, dropout: float, layers: str, seed: int) -> dict[str, list[nn.Parameter]]:
    """Attach fresh LoRA layers to UNet and text encoder, in place.

    Args:
        rank, alpha, dropout: of every layer; the change of a weight is alpha / rank * B A.
        layers: "attention" (the paper's), "qkv" (without its output projections), or "attention+conv" (UNet
            convolutions and feed-forward layers too).
        seed: of the layers' initial values.

    Returns:
        {"unet": parameters, "text": parameters}, float32, requiring gradients.
    Raises:
        ValueError: an SDXL prior, or layers of another name.
    """
    from peft import LoraConfig

    if prior.text_encoder_2 is not None:
        raise ValueError("SDXL cannot be adapted here: it paints references (reference.prior); adapt an SD2-type prior")
    if layers not in ("attention", "qkv", "attention+conv"):
        raise ValueError(f"layers must be 'attention', 'qkv' or 'attention+conv', not {layers!r}")
    targets, of_text = ATTENTION, TEXT_ATTENTION
    if layers == "qkv":
        targets, of_text = ATTENTION[:-1], TEXT_ATTENTION[:-1]
    elif layers == "attention+conv":
        targets = ATTENTION + CONVOLUTIONS
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        for part, names in ((prior.unet, targets), (prior.text_encoder, of_text)):
            part.add_adapter(LoraConfig(r=rank, lora_alpha=alpha, lora_dropout=dropout, target_modules=list(names)))
    set_dropout(prior, False)
    found = {"unet": _lora_parameters(prior.unet), "text": _lora_parameters(prior.text_encoder)}
    if dropout == 0 and prior.dtype == torch.float32:
        _add_to_weights(prior.unet)
    return found


def _add_to_weights(part: nn.Module) -> None:
    """Let its layers with LoRA compute with W', where that takes one product: fewer operations for the same."""
    from peft.tuners.lora import LoraLayer

    for layer in part.modules():
        if isinstance(layer, LoraLayer):
            layer.forward = MethodType(_convolved if isinstance(layer.base_layer, nn.Conv2d) else _multiplied, layer)


def _changed_weight(layer) -> Tensor:
    """W' of a peft layer; of a convolution A has its kernel, and B is 1 x 1."""
    (name,) = layer.active_adapters
    a, b = layer.lora_A[name].weight, layer.lora_B[name].weight
    weight = layer.base_layer.weight
    return weight + (layer.scaling[name] * (b.flatten(1) @ a.flatten(1)).view_as(weight)).to(weight.dtype)


def _convolved(layer, x: Tensor) -> Tensor:
    base = layer.base_layer
    return F.conv2d(x, _changed_weight(layer), base.bias, base.stride, base.padding, base.dilation, base.groups)


def _multiplied(layer, x: Tensor) -> Tensor:
    return F.linear(x, _changed_weight(layer), layer.base_layer.bias)


def _lora_parameters(part: nn.Module) -> list[nn.Parameter]:
    found = []
    for name, parameter in part.named_parameters():
        if "lora_" in name:
            parameter.data = parameter.data.float()
            parameter.requires_grad_(True)
            found.append(parameter)
    return found


def state(prior: Prior) -> dict[str, Tensor]:
    """The LoRA weights by name, for checkpoints."""
    return {
        f"{label}.{name}": parameter.detach().cpu().clone()
        for label, part in (("unet", prior.unet), ("text", prior.text_encoder))
        for name, parameter in part.named_parameters()
        if "lora_" in name
    }


def load_state(prior: Prior, state: dict[str, Tensor]) -> None:
    """Put back what `state` gave, into layers that `add` attached."""
    for label, part in (("unet", prior.unet), ("text", prior.text_encoder)):
        for name, parameter in part.named_parameters():
            if "lora_" in name:
                parameter.data.copy_(state[f"{label}.{name}"])


def set_dropout(prior: Prior, active: bool) -> None:
    """Training mode (LoRA dropout on) or evaluation mode."""
    for part in (prior.unet, prior.text_encoder):
        part.train(active)


def save(prior: Prior, folder: Path) -> None:
    """Write `pytorch_lora_weights.safetensors` as diffusers' `load_lora_weights` reads it, rank and alpha included."""
    from peft import get_peft_model_state_dict

    text = get_peft_model_state_dict(prior.text_encoder, save_embedding_layers=False)
    pipeline_class().save_lora_weights(
        folder,
        unet_lora_layers=get_peft_model_state_dict(prior.unet, save_embedding_layers=False),
        text_encoder_lora_layers=_as_published(text),
        weight_name=LORA_FILE,
        unet_lora_adapter_metadata=_adapter_facts(prior.unet),
        text_encoder_lora_adapter_metadata=_adapter_facts(prior.text_encoder),
    )
    _put_in_order(folder / LORA_FILE)


def _as_published(layers: dict[str, Tensor]) -> dict[str, Tensor]:
    """The text encoder's keys as published LoRA files have them: transformers 5 does without the prefix, transformers 4
    and what else reads such files does not; diffusers takes it off where the encoder has none."""
    return {key if key.startswith("text_model.") else f"text_model.{key}": value for key, value in layers.items()}


def _put_in_order(path: Path) -> None:
    """Sort the facts in the file's header: safetensors writes them in another order each time, and equal weights must
    give equal files, or every stage after this one would run again."""
    content = path.read_bytes()
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:end])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)  # the tensors begin at a multiple of 8
    path.write_bytes(len(text).to_bytes(8, "little") + text + content[end:])


def _adapter_facts(part: nn.Module) -> dict[str, Any]:
    """The adapter's configuration (rank, alpha, layers) in an order of its own, without this machine's paths."""
    facts = next(iter(part.peft_config.values())).to_dict()
    plain = {key: sorted(value) if isinstance(value, set) else value for key, value in sorted(facts.items())}
    return plain | {"base_model_name_or_path": None}


def merged(prior: Prior, folder: Path) -> Prior:
    """The prior adapted by the LoRA in `folder`, merged into the UNet's weights (the text encoder keeps its layers)."""
    if not (folder / LORA_FILE).exists():
        raise ValueError(f"{folder / LORA_FILE} does not exist; run the personalize stage first")
    pipe = pipeline(prior)
    pipe.load_lora_weights(folder, weight_name=LORA_FILE)
    prior.unet.fuse_lora()
    prior.unet.unload_lora()
    for part in (prior.unet, prior.text_encoder):
        part.requires_grad_(False).eval()
    return replace(prior)
