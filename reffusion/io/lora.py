"""Exports LoRA weights for other tools."""

from __future__ import annotations

import json
from pathlib import Path

from reffusion.io.files import reading

FACTS = "lora_adapter_metadata"  # of diffusers: its configuration by part, as JSON


def save_portable(source: Path, path: Path) -> None:
    """Write the LoRA of `source`, as diffusers saved it, for tools that do not read its configuration.

    alpha / rank is multiplied into B, and alpha becomes the rank, so that the weights change by as much. Dropout is 0,
    since the LoRA is for inference.
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
