"""Distillation with an exact denoiser: `python -m benchmarks.studies.control data/demo-mono-5 ... --runs runs`.

The embedded prior is small, so a result with it judges the prior as much as the method. Here the same code distils an
exact prior instead. For each training view, the data distribution consists of `FILLINGS` fillings of its hole, and the
denoiser is the posterior mean over them. It recognises view and window by their known pixels, as any inpainting model
could. A few fillings agree with the reference: the truth, and two pictures close to it. All others are the truth with
the hole's content displaced, or hold content of other scenes. The personalized prior knows only those that agree with
the reference; the prior without personalization, and the empty prompt, know all.

The stages up to `initialize` run in the profile `paper-terms`. Then each of the `METHODS` distils from the same start.
Scored are test views, in the box of the object: LPIPS (vgg) and PSNR, and PSNR outside. The study prints and writes
control.md (differences to `full`, means over scenes with 95 % intervals), control.json and sheet.png to --out. It also
prints the share of known pixels in windows, and how far the estimated depth displaces the reference's pixels in other
views. Scenes are those of the kind `mono`, whose folders hold the truth of the training views.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from reffusion import geometry
from reffusion.distill import depth_estimator
from reffusion.distill.inputs import load_initialization, load_train_views
from reffusion.distill.loop import distill
from reffusion.distill.terms.term import TermInputs
from reffusion.distill.train_view import TrainView
from reffusion.io.arrays import load_json, save_json, save_text
from reffusion.io.ground_truth import load_ground_truth, load_object_mask
from reffusion.io.images import load_exr, load_image, save_image
from reffusion.io.scene import load_references
from reffusion.metrics import lpips
from reffusion.metrics import rows as scores
from reffusion.metrics.view_renders import ViewRenderer
from reffusion.params.distill import Params
from reffusion.prior import diffusion, harmonic_fill, windows
from reffusion.prior.model import Prior, load_prior
from reffusion.seeding import generator
from reffusion.splat import rasterizer
from reffusion.types import Gaussians
from reffusion.workspace import Workspace
from report import page
from report.paired_statistics import confidence_half_width
from report.sheet import compose_sheet
from runner.resolve import Request, resolve

ROOT = Path(__file__).resolve().parents[2]
TINY = ROOT / "priors" / "tiny"
FILLINGS, CLOSE = 50, 3  # fillings of a hole; the first `CLOSE` of them agree with the reference
DISPLACED = 24  # fillings whose content is displaced
DISPLACEMENT = (2.0, 10.0)  # px, smallest and largest displacement
# Method -> variant of pipeline.yaml. "start" is the initialization. In "ceiling" the photographs show the truth, and
# the reconstruction term is the only one.
METHODS = {
    "start": "",
    "ceiling": "",
    "full": "",
    "no_sds": "no_sds",
    "no_local_sds": "no_local_sds",
    "no_personalization": "no_personalization",
    "no_splitting": "no_splitting",
    "no_reference_init": "no_reference_init",
    "no_adversarial": "no_adversarial",
    "no_depth": "no_depth",
}
SCORES = {"lpips_vgg_box": 4, "psnr_box": 2, "psnr_outside": 2}  # column of per_view.csv -> decimals
CEILING = {"sds.weight": 0, "depth.weight": 0, "adversarial.weight": 0}
SHEET_SCALE = 3


# ---------------------------------------------------------------------------------------------- fillings


def displace(picture: Tensor, hole: Tensor, shift: tuple[float, float]) -> Tensor:
    """Return a picture [3, H, W] whose content in the hole is displaced by `shift` (x, y) px, and less near the border.

    Args:
        hole: bool [H, W].
        shift: displacement in the middle of the hole.
    """
    inside = cv2.distanceTransform(hole.numpy().astype(np.uint8), cv2.DIST_L2, 3)
    weight = np.clip(inside / max(np.hypot(*shift), 1), 0, 1).astype(np.float32)
    rows, columns = np.mgrid[: hole.shape[0], : hole.shape[1]]
    x, y = ((axis - weight * by).astype(np.float32) for axis, by in zip((columns, rows), shift, strict=True))
    source = np.ascontiguousarray(picture.permute(1, 2, 0).numpy())
    moved = cv2.remap(source, x, y, cv2.INTER_LINEAR, None, cv2.BORDER_REFLECT)
    return torch.from_numpy(moved).permute(2, 0, 1)


def transplant(picture: Tensor, donors: Tensor, hole: Tensor) -> Tensor:
    """Return pictures [N, 3, H, W] whose holes show the donors [N, 3, H, W], shifted smoothly to the known colours."""
    difference = picture - donors
    shift = harmonic_fill.harmonic_extension(difference, hole.float().expand(len(donors), 1, -1, -1))
    return picture + hole * (shift - difference)


def make_fillings(truth: Tensor, hole: Tensor, donors: Sequence[Tensor], random: np.random.Generator) -> Tensor:
    """Return the fillings of a view's hole, [FILLINGS, 3, H, W] in [-1, 1]; the first `CLOSE` agree with the reference.

    Args:
        truth: [3, H, W], the view without the object.
        hole: bool [H, W], the pixels to fill.
        donors: pictures [3, H, W] of other scenes.
        random: the source of randomness.
    """
    blurred = torch.from_numpy(cv2.GaussianBlur(truth.permute(1, 2, 0).numpy().copy(), (0, 0), 0.5)).permute(2, 0, 1)
    found = [truth, torch.where(hole, blurred, truth), displace(truth, hole, (0.3, 0.3))]
    for _ in range(DISPLACED):
        turn, length = random.uniform(0, 2 * np.pi), random.uniform(*DISPLACEMENT)
        found.append(displace(truth, hole, (length * np.cos(turn), length * np.sin(turn))))
    chosen = [donors[k] for k in random.integers(len(donors), size=FILLINGS - len(found))]
    flipped = [donor.flip(2) if random.random() < 0.5 else donor for donor in chosen]
    return torch.cat([torch.stack(found), transplant(truth, torch.stack(flipped), hole)]).clamp(-1, 1)


# ---------------------------------------------------------------------------------------------- denoiser


class Place(NamedTuple):
    """Where a sample was found: the view's number, and the window's corner, None for a whole view."""

    view: int
    corner: tuple[int, int] | None


class ExactDenoiser(nn.Module):
    """The posterior mean over fillings, in place of a UNet: it takes [z_t | mask | known latents] and predicts v.

    Attributes:
        personalized: whether a prompt other than the empty one selects the fillings that agree with the reference.
    """

    def __init__(self, fillings: Tensor, prior: Prior, empty: Tensor):
        """Prepare the denoiser.

        Args:
            fillings: [V, K, 3, H, W] in [-1, 1], of all views; the first `CLOSE` agree with the reference.
            prior: provides schedule, native size and VAE, whose latents are a linear map of pixels.
            empty: [L, D], the embedding of the empty prompt.
        """
        super().__init__()
        self.alphas, self.size = prior.alphas_cumprod, prior.native_size
        self.empty, self.personalized = empty, True
        with torch.no_grad():  # the VAE is linear, and slower than its matrix
            colors = torch.cat([torch.zeros(1, 3), torch.eye(3)])[..., None, None].expand(4, 3, 8, 8)
            black, *basis = diffusion.encode(prior, colors)[:, :, 4, 4]
            matrix = torch.stack(basis, 1) - black[:, None]
            latents = lambda images: torch.einsum("lc,vkchw->vklhw", matrix, images) + black[:, None, None]
            self.full = latents(fillings)
            self.small = latents(torch.stack([windows.resize(each, self.size, self.size) for each in fillings]))
        self.config = SimpleNamespace(sample_size=self.size, addition_embed_type=None)
        self.anchor = nn.Parameter(torch.zeros(()), requires_grad=False)  # by which the code finds the type of weights
        self.spectra = torch.fft.rfft2(torch.cat([self.full[:, 0], self.full[:, 0].square().sum(1, keepdim=True)], 1))

    def recognize(self, known: Tensor, mask: Tensor) -> Place:
        """Find the view and the window that the known pixels show.

        Args:
            known: [4, S, S], latents of the known pixels.
            mask: [1, S, S], 1 = hole.
        """
        seen = 1 - mask
        whole = ((self.small[:, 0] - known).square() * seen).sum((1, 2, 3))
        height, width = self.full.shape[-2:]
        kernel = torch.cat([-2 * known * seen, seen])
        transformed = torch.fft.rfft2(kernel, s=(height, width))
        error = torch.fft.irfft2((self.spectra * transformed.conj()).sum(1), s=(height, width))
        error = error[:, : height - self.size + 1, : width - self.size + 1] + (known * seen).square().sum()
        if whole.min() < error.min():
            return Place(int(whole.argmin()), None)
        view, top, left = np.unravel_index(int(error.argmin()), error.shape)
        return Place(int(view), (int(top), int(left)))

    def forward(self, sample: Tensor, t: Tensor, encoder_hidden_states: Tensor) -> SimpleNamespace:
        """Return v [B, 4, S, S] as `.sample`, for samples [B, 9, S, S], timesteps [B] and embeddings [B, L, D]."""
        predictions = []
        for row, step, words in zip(sample, t, encoder_hidden_states, strict=True):
            noisy, mask, known = row[:4], row[4:5], row[5:]
            view, corner = self.recognize(known, mask)
            found = self.small[view]
            if corner:
                top, left = corner
                found = self.full[view, ..., top : top + self.size, left : left + self.size]
            if self.personalized and not torch.equal(words, self.empty):
                found = found[:CLOSE]
            abar = self.alphas[step].double()
            signal, spread = abar.sqrt(), (1 - abar).sqrt()
            distance = ((noisy - signal.float() * found) * mask).square().sum((1, 2, 3)).double()
            weight = torch.softmax(-distance / (2 * spread.square()), 0).float()
            clean = torch.einsum("k,kchw->chw", weight, found)
            eps = (noisy - signal * clean) / spread
            predictions.append((signal * eps - spread * clean).float())
        return SimpleNamespace(sample=torch.stack(predictions))


def make_prior(fillings: Tensor) -> tuple[Prior, Tensor]:
    """Return a prior with an exact denoiser, and the embeddings [3, L, D] of the global, local and empty prompt.

    Args:
        fillings: as of `ExactDenoiser`.
    """
    prior = replace(load_prior(TINY), fills=False, contrast=0.0)
    # Any embeddings that differ will do, and those of the prior's text encoder need not.
    text = torch.eye(3)[:, None]
    return replace(prior, unet=ExactDenoiser(fillings, prior, text[2]), text_encoder=None), text


# ---------------------------------------------------------------------------------------------- one scene


def run_stages(scene: Path, runs: Path, method: str, more: str) -> tuple[Path, Params]:
    """Run the stages up to `initialize` for a method, and return its folder and the parameters of `distill`.

    Raises:
        ValueError: a stage failed.
    """
    variant = METHODS[method]
    command = ["run", "initialize", "--scene", scene, "--runs", runs, "--profile", "paper-terms", "--variant", variant]
    if subprocess.run([sys.executable, "-m", "runner", *map(str, command), "--set", more], cwd=ROOT).returncode:
        raise ValueError(f"{scene.name}, {method}: a stage failed; see above")
    request = Request(ROOT, runs, str(scene), profile="paper-terms", variant=variant or None, set=more)
    return runs / (f"{scene.name}@{variant}" if variant else scene.name), Params(**resolve(request).params["distill"])


def load_truth(scene: Path, views: Sequence[TrainView]) -> list[Tensor]:
    """Load the training views without the object, [3, H, W] in [-1, 1] each.

    Raises:
        ValueError: the scene does not hold them.
    """
    folder = scene / "truth" / "without_object"
    if not folder.is_dir():
        raise ValueError(f"{folder} is missing: make the scene by `python data/generate.py --kind mono --out {scene}`")
    pictures = [load_image(folder / f"{view.camera.name}.png") for view in views]
    return [torch.from_numpy(picture).permute(2, 0, 1) / 127.5 - 1 for picture in pictures]


def show_truth(view: TrainView, truth: Tensor) -> TrainView:
    """Return a training view whose photograph is the truth [3, H, W] in [-1, 1], and supervises everywhere."""
    photo = ((truth.permute(1, 2, 0) + 1) * 127.5).round().to(torch.uint8)
    nothing = torch.zeros_like(view.repaint)
    return replace(view, photo=photo, supervises=~nothing, repaint=nothing, clean=True)


def measure_displacement(run: Path, scene: Path, size: int) -> float:
    """Return the median displacement of the reference's pixels in other views by the error of its estimated depth.

    Only pixels of the hole count. The unit is a pixel of a whole view as the prior sees it.

    Args:
        size: side in pixels of such a view.
    """
    space = Workspace(run / "poses", run / "fit", run / "masks")
    (reference,) = load_references(run / "reference", space.scene)
    camera, hole = reference.camera, reference.mask
    estimate = load_exr(run / "initialize" / "depth" / f"{camera.name}.exr").astype(np.float64)
    true = np.load(scene / "truth" / "depth" / f"{camera.name}.npy").astype(np.float64)
    rendered = rasterizer.render(space.remaining, camera).depth.double().numpy()
    true *= np.median((rendered / true)[~hole & (rendered > 0)])
    found = []
    for name in space.scene.train:
        other = space.scene.cameras[name]
        ends = [geometry.project(geometry.unproject(depth, camera)[hole], other)[0] for depth in (estimate, true)]
        found.append(np.linalg.norm(ends[0] - ends[1], axis=1) * size / other.width)
    return float(np.median(np.concatenate(found)))


def measure_known_share(views: Sequence[TrainView], size: int) -> tuple[float, float]:
    """Return the median and the smallest share of known pixels in the windows that distillation draws."""
    shares = []
    for view in views:
        for seed in range(8 if view.repaint.any() else 0):
            top, left = windows.window_around(view.repaint, size, generator(seed, view.camera.name))
            shares.append(1 - float(view.repaint[top : top + size, left : left + size].float().mean()))
    return float(np.median(shares)), min(shares)


@torch.no_grad()
def score(gaussians: Gaussians, run: Path, models: dict[str, lpips.Lpips]) -> tuple[dict[str, float], np.ndarray]:
    """Return the mean `SCORES` over the test views, and the middle test view as rendered."""
    space, scored, pictures = Workspace(run / "poses", run / "fit", run / "masks"), [], []
    renderer = ViewRenderer({"distill": gaussians}, "distill", None, {})
    for name in space.scene.test:
        camera = space.scene.cameras[name]
        picture = load_ground_truth(camera, run / "poses")
        view = renderer.render(camera, load_object_mask(camera, run / "raw_masks", run / "masks"), picture).result
        scored.append(scores.score_row(view, None, scores.GroundTruth(picture, False, None), models))
        pictures.append(view.picture)
    mean = scores.summarize(scored)["mean"]
    return {name: mean[name] for name in SCORES}, pictures[len(pictures) // 2]


class Exact(NamedTuple):
    """The truth of a scene, and the exact prior.

    Attributes:
        truth: the training views without the object, [3, H, W] in [-1, 1] each.
        prior: as of `make_prior`.
        text: [3, L, D], as of `make_prior`.
    """

    truth: list[Tensor]
    prior: Prior
    text: Tensor


def prepare(scene: Path, run: Path, views: Sequence[TrainView], donors: Sequence[Tensor]) -> Exact:
    """Load the truth, make the exact prior, and print the displacement of the start and the share of known pixels."""
    truth, random = load_truth(scene, views), np.random.default_rng(0)
    fillings = [make_fillings(each, view.repaint, donors, random) for each, view in zip(truth, views, strict=True)]
    prior, text = make_prior(torch.stack(fillings))
    size = prior.native_size
    print(f"{scene.name}: displacement of the start {measure_displacement(run, scene, size):.2f} px of the prior")
    middle, least = measure_known_share(views, size)
    print(f"{scene.name}: known share of windows, median {middle:.2f}, least {least:.2f}")
    return Exact(truth, prior, text)


def measure_scene(
    scene: Path, runs: Path, donors: Sequence[Tensor], methods: Sequence[str], more: str, out: Path
) -> tuple[dict[str, dict[str, float]], list[np.ndarray]]:
    """Distil a scene by each method.

    Args:
        donors: pictures [3, H, W] in [-1, 1] of other scenes.
        more: parameters, as `set=` of the command line.
        out: folder for checkpoints.

    Returns:
        Method -> scores; and the middle test view by each method.

    Raises:
        ValueError: the weights of LPIPS are missing, or as for `run_stages` and `load_truth`.
    """
    network, reason = lpips.load("vgg")
    if network is None:
        raise ValueError(f"LPIPS cannot be measured: {reason}")
    home, exact, found, pictures = runs / scene.name, None, {}, []
    for method in methods:
        run, params = run_stages(scene, runs, method, more)
        # A variant shares what it does not change.
        part = lambda stage, run=run: next(place / stage for place in (run, home) if (place / stage).is_dir())
        space = Workspace(part("poses"), part("fit"), part("masks"))
        gaussians, masked, references = load_initialization(params, space.scene, part("reference"), part("initialize"))
        if method != "start":
            views = load_train_views(params, space, part("initialize"))
            exact = exact or prepare(scene, home, views, donors)
            exact.prior.unet.personalized = method != "no_personalization"
            if method == "ceiling":
                views = [show_truth(view, each) for view, each in zip(views, exact.truth, strict=True)]
                params = params.changed(CEILING)
            estimator = depth_estimator.build_estimator(params, space.scene.points) if params.depth.weight else None
            inputs = TermInputs(views, references, gaussians.means[masked], exact.prior, exact.text, estimator, None)
            folder = out / scene.name / method
            folder.mkdir(parents=True, exist_ok=True)
            gaussians, _ = distill(gaussians, masked, inputs, params, folder)
        found[method], picture = score(gaussians, home, {"vgg": network})
        pictures.append(picture)
        print(f"{scene.name}, {method}: " + ", ".join(f"{name} {value:.4f}" for name, value in found[method].items()))
    return found, pictures


def tabulate(found: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """Return a Markdown table of each method minus `full`: means over scenes and their 95 % intervals."""
    table = []
    for method in next(iter(found.values())):
        cells = [f"`{method}`"]
        for column, digits in SCORES.items():
            values = np.array([each[method][column] for each in found.values()])
            if method != "full":
                values = values - np.array([each["full"][column] for each in found.values()])
            half = confidence_half_width(values)
            sign = "" if method == "full" else "+"
            cells.append(f"{values.mean():{sign}.{digits}f}" + (f"±{half:.{digits}f}" if half is not None else ""))
        table.append(cells)
    return page.markdown_table(["minus `full`", "LPIPS (vgg)", "PSNR, dB", "outside, dB"], table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path, help="folders of scenes of the kind `mono`, two or more")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="folder of runs")
    parser.add_argument("--out", type=Path, default=Path("runs/control"))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--set", default="", help="parameters, as in `make set=...`")
    arguments = parser.parse_args()
    scenes, out = [scene.resolve() for scene in arguments.scenes], arguments.out.resolve()
    found = load_json(out / "control.json") if (out / "control.json").exists() else {}
    sheet: dict[str, list[np.ndarray]] = {}
    truth = {s: [load_image(p) for p in sorted((s / "truth/without_object").glob("*.png"))] for s in scenes}
    for scene in scenes:
        if scene.name in found:
            continue
        others = [picture for other, pictures in truth.items() if other != scene for picture in pictures]
        donors = [torch.from_numpy(picture).permute(2, 0, 1) / 127.5 - 1 for picture in others]
        found[scene.name], pictures = measure_scene(
            scene, arguments.runs.resolve(), donors, arguments.methods, arguments.set, out
        )
        sheet[scene.name] = [picture.repeat(SHEET_SCALE, 0).repeat(SHEET_SCALE, 1) for picture in pictures]
        save_json(out / "control.json", found)
        save_image(out / "sheet.png", compose_sheet([*sheet.values()], [*arguments.methods], [*sheet]))
    save_text(out / "control.md", tabulate(found))
    print(tabulate(found))


if __name__ == "__main__":
    try:
        main()
    except ValueError as error:
        sys.exit(f"error: {error}")
