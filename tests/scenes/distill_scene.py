"""A small wall of random Gaussians whose middle is masked, and training views and settings for its distillation."""

import math

import torch

from reffusion.distill.train_view import TrainView
from reffusion.io.ply import save_ply
from reffusion.io.scene import save_mask_sets, save_scene
from reffusion.params.distill import AdversarialTerm, Params, SdsTerm
from reffusion.seeding import generator
from reffusion.types import PARAMETERS, Gaussians, MaskSet
from scenes.cameras import make_camera, make_scene
from scenes.gaussians import round_gaussians
from scenes.settings import with_changes

WIDTH, HEIGHT = 36, 28
SDS = SdsTerm(weighting="x0", guidance=0.0)
ADVERSARIAL = AdversarialTerm(patches=4, size=8, width=4)


def wall_camera(name="a", shift=0.0):
    """Return a camera that looks at the wall from a distance of 1, `shift` to the left of the wall's middle."""
    return make_camera(name, (WIDTH, HEIGHT), 30.0, (-shift, 0.0, -1.0))


def random_wall(count=150, seed=0):
    """Return Gaussians on a wall in front of the camera, and bool [N], True for the Gaussians in the wall's middle."""
    draw = generator(seed, "wall")
    means = torch.rand(count, 3, generator=draw) * torch.tensor([1.2, 0.9, 0.1]) - torch.tensor([0.6, 0.45, 0.0])
    sh = torch.zeros(count, 4, 3)
    sh[:, 0] = torch.randn(count, 3, generator=draw)
    sh[:, 1:] = 0.1 * torch.randn(count, 3, 3, generator=draw)
    gaussians = Gaussians(
        means,
        torch.randn(count, 4, generator=draw),
        torch.full((count, 3), -3.2) + 0.2 * torch.randn(count, 3, generator=draw),
        torch.randn(count, generator=draw) + 1,
        sh,
    )
    return gaussians, (means[:, 0].abs() < 0.25) & (means[:, 1].abs() < 0.2)


def square_hole():
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[8:20, 11:25] = True
    return mask


def train_view(name="a", shift=0.0, clean=False):
    photo = torch.rand(HEIGHT, WIDTH, 3, generator=generator(3, name))
    supervises = torch.ones_like(square_hole()) if clean else ~square_hole()
    return TrainView(wall_camera(name, shift), photo, supervises, square_hole() & (not clean), clean)


def as_leaves(gaussians):
    return gaussians.map(lambda p: p.clone().requires_grad_())


def has_gradient(gaussians):
    """Return bool [N], True for the Gaussians of which any parameter has a nonzero gradient."""
    columns = [getattr(gaussians, name).grad.flatten(1).ne(0).any(1) for name in PARAMETERS if name != "opacity_logits"]
    return torch.stack([*columns, gaussians.opacity_logits.grad != 0]).any(0)


SETTINGS = Params(
    iterations=6, sds=SDS, depth={"weight": 0}, adversarial=ADVERSARIAL, reference={"weight": 0.5},
    densify={"every": 2, "grow_grad2d": 1e-6}, checkpoint_seconds=1e-9,
)  # fmt: skip
OFF = {"weight": 0}
PLAIN = with_changes(SETTINGS, adversarial=OFF, reference=OFF, densify={"every": 0})


def has_changed(before, after):
    """Return bool [N], True for the Gaussians of which any parameter differs."""
    rows = [(getattr(before, n) != getattr(after, n)).reshape(len(before), -1) for n in PARAMETERS]
    return torch.cat(rows, 1).any(1)


def write_initialized_run(home, invent):
    """Write a run of a wall before three views up to `initialize`; return the folder.

    Args:
        home: folder to which the folders of the stages are written.
        invent: bool [H, W], the hole in each view (the pixels to be invented).
    """
    draw = generator(0, "wall")
    means = torch.rand(80, 3, generator=draw) * torch.tensor([1.6, 1.2, 0.1]) - torch.tensor([0.8, 0.6, -1.5])
    wall = round_gaussians(means, torch.full((80, 3), 0.5), math.exp(-2.0), 2.0)
    names, height, width = ("a", "b", "c"), *invent.shape
    cameras = {name: make_camera(name, (width, height), 40.0) for name in names}
    save_scene(home / "poses", make_scene(cameras, clean=("c",)))
    save_ply(home / "initialize" / "gaussians.ply", wall)
    save_mask_sets(home / "masks", dict.fromkeys(names, MaskSet(*[invent] * 4)))
    return home
