"""Export of LoRA weights for other tools."""

from __future__ import annotations

import json
from pathlib import Path

from reffusion.io.files import reading

FACTS = "lora_adapter_metadata"  # metadata key of diffusers: JSON with "<part>.r", "<part>.lora_alpha" and others


def save_portable(source: Path, path: Path) -> None:
    """Write a copy of a LoRA that has the same effect in tools that ignore the configuration in its metadata.

    A LoRA adds (alpha / rank) B A to a weight matrix. Here the factor alpha / rank is multiplied into B, and alpha is
    set to the rank, so that the product stays the same with a factor of 1. Dropout is set to 0, because the copy is for
    inference. Weights without a rank in the metadata stay as they are.

    Args:
        source: the .safetensors file that diffusers saved.
        path: the file to write; its folder is created.

    Raises:
        BadInput: `source` is unreadable.
    """
    from safetensors import safe_open
    from safetensors.torch import save_file

    with reading(source, "LoRA weights"), safe_open(source, "pt") as file:
        facts = json.loads((file.metadata() or {}).get(FACTS, "{}"))
        tensors = {name: file.get_tensor(name) for name in file.keys()}
    for part in {name.split(".")[0] for name in tensors}:
        rank = facts.get(f"{part}.r")
        scale = facts[f"{part}.lora_alpha"] / rank if rank else 1.0
        for name in tensors:
            if name.startswith(f"{part}.") and name.endswith("lora_B.weight"):
                tensors[name] = tensors[name] * scale
        facts |= {f"{part}.lora_alpha": rank, f"{part}.lora_dropout": 0.0} if rank else {}
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file(tensors, path, {"format": "pt", FACTS: json.dumps(facts, indent=2, sort_keys=True)})
