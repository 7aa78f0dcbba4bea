"""Painters with random weights or simple graphs, in the formats of published ones."""

from pathlib import Path
from typing import Any

import torch

from reffusion.weights.published import MOEBIUS
from scenes.networks import TINY


def save_small_sd3(folder: Path) -> None:
    """Write a small Stable Diffusion 3 with random weights, without its third text encoder, which is optional."""
    from diffusers import (
        AutoencoderKL,
        FlowMatchEulerDiscreteScheduler,
        SD3Transformer2DModel,
        StableDiffusion3Pipeline,
    )
    from transformers import CLIPTextModel, CLIPTextModelWithProjection, CLIPTokenizer

    config = CLIPTextModel.from_pretrained(TINY / "text_encoder").config
    for name, value in {"projection_dim": 16, "hidden_size": 16, "num_attention_heads": 2}.items():
        setattr(config, name, value)
    torch.manual_seed(0)
    transformer = SD3Transformer2DModel(
        sample_size=8,
        patch_size=1,
        num_layers=1,
        attention_head_dim=8,
        num_attention_heads=2,
        joint_attention_dim=32,
        caption_projection_dim=16,
        pooled_projection_dim=32,
    )
    levels = 4
    vae = AutoencoderKL(
        latent_channels=16,
        block_out_channels=(4,) * levels,
        norm_num_groups=2,
        down_block_types=("DownEncoderBlock2D",) * levels,
        up_block_types=("UpDecoderBlock2D",) * levels,
        use_quant_conv=False,
        use_post_quant_conv=False,
        shift_factor=0.06,
    )
    tokenizer = CLIPTokenizer.from_pretrained(TINY / "tokenizer")
    StableDiffusion3Pipeline(
        transformer=transformer,
        scheduler=FlowMatchEulerDiscreteScheduler(),
        vae=vae,
        text_encoder=CLIPTextModelWithProjection(config),
        tokenizer=tokenizer,
        text_encoder_2=CLIPTextModelWithProjection(config),
        tokenizer_2=tokenizer,
        text_encoder_3=None,
        tokenizer_3=None,
    ).save_pretrained(folder)


def save_moebius(folder: Path, scaling: float = 0.13025, **changes: Any) -> Path:
    """Write graphs with the published inputs and outputs of Moebius; return the folder.

    The encoder averages blocks of pixels, and the decoder repeats latents. The UNet predicts the noise of clean latents
    which are those of the masked picture, plus in the mask .3 for the prompt and .2 for the empty one, so that the
    sampler must end at values that are known.

    Args:
        scaling: factor of the latents.
        changes: deviations from the published graphs: "channels" and "batch" of the UNet's input, "side" of the
            decoder's output.
    """
    from onnx import TensorProto, helper

    FLOAT, LONG = TensorProto.FLOAT, TensorProto.INT64
    value, node = helper.make_tensor_value_info, helper.make_node
    number = lambda name, *numbers, kind=FLOAT: helper.make_tensor(
        name, kind, [len(numbers)] if kind == LONG else [], numbers
    )
    folder.mkdir(parents=True, exist_ok=True)

    def write(name: str, nodes: list, inputs: list, output: Any, constants: list) -> None:
        import onnx

        graph = helper.make_graph(nodes, name, inputs, [output], constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
        onnx.save(model, str(folder / name))

    write(
        MOEBIUS.encoder,
        [
            node("AveragePool", ["image"], ["colors"], kernel_shape=[8, 8], strides=[8, 8]),
            node("Pad", ["colors", "pads"], ["moments"]),
        ],
        [value("image", FLOAT, ["B", 3, 512, 512])],
        value("moments", FLOAT, ["B", 8, 64, 64]),
        [number("pads", 0, 0, 0, 0, 0, 5, 0, 0, kind=LONG)],
    )
    betas = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2
    kept = (1 - betas).cumprod(0)
    table = lambda name, values: helper.make_tensor(name, FLOAT, [1000, 1, 1, 1], values.float().tolist())
    slices = [
        node("Slice", ["latent", f"from{i}", f"to{i}", "axis"], [part])
        for i, part in enumerate(("noisy", "mask", "known"))
    ]
    write(
        MOEBIUS.unet,
        [
            *slices,
            node("Slice", ["input_ids", "from0", "axis", "axis"], ["id"]),  # the first column
            node("Cast", ["id"], ["row"], to=FLOAT),
            node("Reshape", ["row", "shape"], ["rows"]),
            node("Mul", ["rows", "slope"], ["less"]),
            node("Sub", ["most", "less"], ["tone"]),
            node("Mul", ["tone", "scaling"], ["scaled"]),
            node("Mul", ["scaled", "mask"], ["added"]),
            node("Add", ["added", "known"], ["clean"]),
            node("Gather", ["signals", "timesteps"], ["signal"]),
            node("Gather", ["noises", "timesteps"], ["level"]),
            node("Mul", ["clean", "signal"], ["shown"]),
            node("Sub", ["noisy", "shown"], ["rest"]),
            node("Div", ["rest", "level"], ["noise"]),
        ],
        [
            value("latent", FLOAT, [changes.get("batch", "B"), changes.get("channels", 9), 64, 64]),
            value("timesteps", LONG, ["B"]),
            value("input_ids", LONG, ["B", 10]),
        ],
        value("noise", FLOAT, None),
        [
            table("signals", kept.sqrt()),
            table("noises", (1 - kept).sqrt()),
            number("slope", 0.01),
            number("most", 0.3),
            number("scaling", scaling),
            number("axis", 1, kind=LONG),
            number("shape", -1, 1, 1, 1, kind=LONG),
            *(number(f"from{i}", start, kind=LONG) for i, start in enumerate((0, 4, 5))),
            *(number(f"to{i}", end, kind=LONG) for i, end in enumerate((4, 5, 9))),
        ],
    )
    write(
        MOEBIUS.decoder,
        [
            node("Slice", ["latent", "from", "to", "axis"], ["colors"]),
            node("Resize", ["colors", "", "", "sizes"], ["whole"], mode="nearest"),
            node("Identity", ["whole"], ["image"]),
        ],
        [value("latent", FLOAT, ["B", 4, 64, 64])],
        value("image", FLOAT, None),
        [
            number("from", 0, kind=LONG),
            number("to", 3, kind=LONG),
            number("axis", 1, kind=LONG),
            number("sizes", 1, 3, changes.get("side", 512), changes.get("side", 512), kind=LONG),
        ],
    )
    return folder
