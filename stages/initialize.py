"""initialize: masked Gaussians out; the references' pixels, on completed depth, in as new masked Gaussians."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

WARN_FROM = 0.01  # share of C that shows nothing, from which a view is named


class Params(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    start: Literal["reference", "lift", "random", "nothing"] = Field(
        "reference",
        description="what fills the hole: the reference on its depth; instead (baselines) the picture that the stage "
        "lift painted of the best view, Gaussians at random (initialize.scatter), or nothing: it only removes",
    )
    random_gaussians: int = Field(0, ge=0, description="their number, started at random; 0: as many as were removed")
    leak: float = Field(1.0, gt=0, description="weight in undecided over other pixels from which Gaussians are haze")
    overlap: float = Field(0.006, ge=0, description="how far new Gaussians reach beyond the hole, / image width")
    covered: float = Field(0.9, gt=0, le=1, description="alpha below which the reference also fills pixels of C")
    seen_through: float = Field(
        0.5, ge=0, lt=1, description="alpha in C of any view below which there is a gap to fill"
    )
    explained: float = Field(0.5, gt=0, lt=1, description="alpha from which remaining Gaussians' depth is known")
    margin: float = Field(0.01, ge=0, description="known depth nearer to the hole than this is left out, / image width")
    ring: float = Field(0.08, gt=0, description="surroundings whose depth is continued, / image width")
    planar_share: float = Field(0.7, ge=0, description="planes are taken if they explain this share of the ring")
    planar_tolerance: float = Field(0.01, gt=0, description="relative disparity within which a plane explains")
    stiffness: float = Field(100.0, gt=0, description="bending against data in the smooth completion, px^4")
    edge: float = Field(0.1, gt=0, description="step of the reference's colour that lets depth bend, colours in [0, 1]")
    unknowns: int = Field(60_000, ge=100, description="pixels in the completion; more are solved on a coarser grid")
    solver_smoothness: float = Field(128.0, gt=0, description="bilateral solver: lambda")
    solver_spatial: float = Field(8.0, gt=0, description="bilateral solver: cell size, px")
    solver_luma: float = Field(8.0, gt=0, description="bilateral solver: cell size, levels of 255")
    solver_chroma: float = Field(8.0, gt=0, description="bilateral solver: cell size, levels of 255")
    seed: int = Field(0, description="of the draws that find planes")
    spread: float = Field(0.3, gt=0, description="standard deviation of new Gaussians, pixels of the reference")
    thickness: float = Field(0.1, gt=0, description="their deviation along the normal over that within the surface")
    grazing: float = Field(0.15, gt=0, le=1, description="least cosine to the view at which they are stretched")
    # PAPER leaves open: opacity. Of opaque neighbours the nearer one hides half of the next, so that what is painted on
    # them seems to slide by a third of a pixel, the other way in views from the other side. Thin ones slide less; a
    # second sheet behind them keeps the surface closed. See docs/initialization.md.
    opacity: float = Field(0.4, gt=0, lt=1, description="their opacity")
    sunk: float = Field(1.0, ge=0, description="a second sheet lies so many pixels behind the first; 0: there is none")
    under_spread: float = Field(0.6, gt=0, description="standard deviation of its Gaussians, pixels of the reference")
    under_opacity: float = Field(0.8, gt=0, lt=1, description="its opacity")
    # PAPER leaves open: the depth model of the reference, and whether its alignment is plain or robust.
    depth_model: str | None = Field(
        None,
        description="depth model of the reference: a transformers folder, or the name of one on the hub; none: "
        "the surroundings are continued",
        json_schema_extra={"weights": True},
    )
    depth_align: Literal["l2", "robust"] = Field("l2", description="fit of its scale and offset on known pixels")
    color_steps: int = Field(5, ge=0, description="corrections of their colours until the reference is reproduced")
    # PAPER leaves open: the new Gaussians' view-dependent colour. The reference shows one side only.
    sweep: bool = Field(False, description="depth around the hole is found anew by comparing the photographs")
    gloss: bool = Field(False, description="they change with the direction as the surfaces around them do")
    # PAPER leaves open: what the reference's camera does not see of the hole.
    further: int = Field(0, ge=0, description="most views completed beside the references, until nothing is uncovered")
    settle: int = Field(0, ge=0, description="steps of reconstruction after filling; 0: none")


def needed_weights(params: Params, brings: frozenset[str]) -> list:
    """What must lie on this machine, and what of it does not; `brings`: the keys of scene.yaml."""
    from reffusion.weights import local

    return [local.of_model(params.depth_model, "float32")] if params.depth_model else []


def preview(params: Params, **_: Path | None) -> list[str]:
    """What the stage will do, as far as that is known before it looks."""
    if not (params.further and params.start == "reference"):
        return []
    return [f"completes up to {params.further} further views from pieces of themselves: what no reference shows"]


def run(
    params: Params, out: Path, *, poses: Path, fit: Path, masks: Path, reference: Path | None, lift: Path | None = None
) -> None:
    import torch

    from reffusion import trace
    from reffusion.depth import monocular
    from reffusion.initialize import filling
    from reffusion.io.arrays import load_json, load_labels, save_json, save_labels
    from reffusion.io.ply import load_ply, save_ply
    from reffusion.io.scene import load_mask_sets, load_references, load_scene
    from reffusion.masks import voting

    gaussians, labels = load_ply(fit / "gaussians.ply"), load_labels(masks / "labels.npy")
    if len(labels) != len(gaussians):
        raise ValueError(f"{masks}: {len(labels)} labels for {len(gaussians)} Gaussians of {fit}: run masks again")
    scene = load_scene(poses)
    if params.start == "lift" and lift is None:
        raise ValueError("initialize.start is 'lift', but the stage lift was left out: set distill.lift_weight")
    completed = {"reference": reference, "lift": lift}.get(params.start)
    references = load_references(completed, scene) if completed else []
    network = monocular.load_network(params.depth_model) if params.depth_model and references else None
    sets = load_mask_sets(masks, scene.cameras)
    thing = labels & ~debris_of(masks, labels)
    around = surroundings(params, scene, gaussians, thing, sets, poses, fit) if references else None
    removed = gaussians.map(lambda p: p[thing])
    gaussians = gaussians.map(lambda p: p[~labels])
    new = torch.zeros(len(gaussians), dtype=torch.bool)
    train = [scene.cameras[name] for name in scene.train]
    haze = torch.zeros(len(gaussians), dtype=torch.bool)
    if params.start != "nothing":  # where nothing is put in its place, haze is better than a black hole
        haze = voting.leaking(gaussians, train, {c.name: sets[c.name].undecided for c in train}, params.leak)
    gaussians, new = gaussians.map(lambda p: p[~haze]), new[~haze]
    best = load_json(masks / "facts.json")["best_reference"]
    log = trace.Trace(out) if references else None
    for each in sorted(references, key=lambda r: (r.camera.name != best, -int(r.mask.sum()))):
        gaussians, new = filled(params, out, gaussians, new, each, around, network, log)
    true = true_pictures(reference, references, around) if references and params.start == "reference" else []
    if true and params.settle:
        true, around = without_shadows(out, true, gaussians, around)
    further = []
    if true and params.further:
        gaussians, new, further = completed_further(params, out, gaussians, new, around)
        true += further
    if params.start == "random" and any(each.invent.any() for each in sets.values()):
        added = at_random(params, removed, gaussians, scene, sets, poses)
        gaussians = gaussians.zipped(added, lambda a, b: torch.cat([a, b]))
        new = torch.cat([new, torch.ones(len(added), dtype=torch.bool)])
    if true and params.settle:
        gaussians = settled(params, out, gaussians, true, around)
    save_ply(out / "gaussians.ply", gaussians)
    save_labels(out / "labels.npy", new)
    uncovered = {each.name: filling.uncovered(gaussians, each, sets[each.name].consistent) for each in train}
    facts = {"new_gaussians": int(new.sum()), "removed_gaussians": int(labels.sum()), "haze": int(haze.sum())}
    facts |= {"completed": [each.camera.name for each in true], "uncovered": uncovered}
    facts["further"] = {
        each.camera.name: float(each.mask.sum() / sets[each.camera.name].consistent.sum()) for each in further
    }
    facts["uncovered_share"] = sum(uncovered.values()) / max(len(uncovered), 1)
    save_json(out / "facts.json", facts)
    if bare := [f"{name} ({share:.1%})" for name, share in uncovered.items() if share > WARN_FROM]:
        print(f"uncovered in {len(bare)} views: {', '.join(bare)}: complete another view and add it to the references")


def debris_of(masks: Path, labels):
    """bool [N]: of what goes, what was not the object."""
    import torch

    from reffusion.io.arrays import load_labels

    path = masks / "debris.npy"
    return load_labels(path) if path.exists() else torch.zeros_like(labels)


def surroundings(params: Params, scene, gaussians, thing, sets, poses: Path, fit: Path):
    """What the photographs say of the space around the object, and the planes that go on into what they do not."""
    from reffusion.fit import exposure
    from reffusion.initialize import filling
    from reffusion.masks import continuation, voting, witness

    hidden = {name: each.consistent & (name not in scene.clean) for name, each in sets.items()}
    train = [scene.cameras[name] for name in scene.train]
    views = witness.witnesses(gaussians, train, hidden)
    planes = []
    if thing.any():
        planes = continuation.planes_around(*voting.extent(gaussians.means[thing]), views, params.seed)
    photos = exposure.load_views(poses, fit, scene.train)
    return filling.Surroundings(train, {n: sets[n].consistent for n in sets}, photos, views, planes, scene.points)


def at_random(params: Params, removed, remaining, scene, sets, poses: Path):
    """Gaussians at random in the region of the hole: that of the removed ones, or the box that the scene names."""
    from reffusion import seeding
    from reffusion.initialize import scatter
    from reffusion.io.arrays import load_json

    region, train = poses / "region.json", [scene.cameras[name] for name in scene.train]
    if region.exists():
        box = scatter.box_around(**load_json(region))
    elif len(removed):
        box = scatter.box_of(removed.means.double().numpy())
    else:
        raise ValueError("initialize.start is 'random', but no Gaussian was removed: nothing says where the hole is")
    invents = {camera.name: sets[camera.name].invent for camera in train if sets[camera.name].invent.any()}
    count = params.random_gaussians or max(len(removed), scatter.FEWEST)
    points = scatter.points_in(box, count, train, invents, seeding.generator(params.seed, "initialize", "random"))
    draw = seeding.generator(params.seed, "initialize", "random colours")
    return scatter.gaussians_at(points, remaining.sh.shape[1], remaining.antialiased, draw)


def filled(params: Params, out: Path, gaussians, new, reference, around, network, log, farthest=False):
    """The Gaussians with those of one reference, on what is still empty in its mask, and the labels."""
    from dataclasses import fields

    from reffusion.depth import behind
    from reffusion.initialize import filling
    from reffusion.io.images import save_exr
    from reffusion.masks import undecided

    camera, sheets = reference.camera, {f.name: getattr(params, f.name) for f in fields(filling.Sheets)}
    sheets["gloss"] &= not farthest  # a sliver tells nothing of shine
    sheets, how, hidden = filling.Sheets(**sheets), completion(params), around.hidden[reference.camera.name]
    hole = filling.to_fill(gaussians, new, reference, hidden, params.covered)
    remaining = gaussians.map(lambda p: p[~new])
    near, told = around.compared(camera, hole) if params.sweep else (around, None)
    continued = undecided.behind(remaining, camera, hidden, near.views, near.planes).continued
    past = (lambda depth: near.looked_past(camera, depth)) if params.sweep else None
    hints = behind.Hints(continued, near.photographed(camera), told, past)
    estimate = estimate_of(network, reference)
    depth, made_up, said = filling.depth_behind(
        remaining, reference, hole, hidden, around.points, how, estimate, log, hints, farthest
    )
    print(f"depth of reference {camera.name}: {said}")
    save_exr(out / "depth" / f"{camera.name}.exr", depth.astype("float32"))
    pixels = behind.grown(hole, params.overlap)
    gaussians, new = filling.placed(gaussians, new, reference, depth, pixels, around, sheets)
    if farthest:  # what is open still is asked for view by view
        return gaussians, new
    views = [(each, around.hidden[each.name]) for each in around.cameras]
    gap = filling.seen_through(gaussians, camera, made_up, hidden & ~pixels, views, params.seen_through)
    if not gap.any():
        return gaussians, new
    return filling.placed(gaussians, new, reference, made_up, gap, around, sheets)


def true_pictures(reference: Path, references: list, around) -> list:
    """The references, each standing for all of which it knows more than the Gaussians do: a picture that the scene
    brings for all of C, one that was completed here for what was invented."""
    from dataclasses import replace

    from reffusion.io.arrays import load_json

    facts = reference / "facts.json"
    given = load_json(facts)["given"] if facts.exists() else []
    whole = lambda each: replace(each, mask=each.mask | around.hidden[each.camera.name])
    return [whole(each) if each.camera.name in given else each for each in references]


def without_shadows(out: Path, true: list, gaussians, around):
    """The references, standing also for what the object had tainted, and the surroundings with photographs in their
    light; these say nothing where it is not known. Writes tainted/<view>.png where there is something."""
    from dataclasses import replace

    import numpy as np

    from reffusion.io.images import save_mask
    from reffusion.masks import taint
    from reffusion.masks.witness import with_photographed_depth
    from reffusion.prior import inpaint
    from reffusion.splat import rasterizer

    marks = {camera.name: np.zeros((camera.height, camera.width), bool) for camera in around.cameras}
    silent, photos = dict(marks), dict(around.photos)
    pictures = []
    for each in true:
        name = each.camera.name
        hidden = around.hidden[name]
        shown = inpaint.background(gaussians, each.camera, photos[name], hidden)
        found = taint.tainted(each.image, shown, hidden)
        pictures.append(replace(each, mask=each.mask | found))
        if not found.any():
            continue
        print(f"reference {name}: beside the hole {found.sum()} px differ from what is seen, a shadow perhaps")
        depth = rasterizer.render(gaussians, each.camera, sh_degree=0).depth.double().numpy()
        depth = with_photographed_depth(depth, each.camera, around.views)
        brighter = taint.light(each.image, shown)
        for view, (mask, light) in taint.carried(found, brighter, depth, each.camera, around.views).items():
            photos[view] = taint.relit(photos[view], light)
            marks[view], silent[view] = marks[view] | mask, silent[view] | (mask & np.isnan(light).any(-1))
    if not any(mask.any() for mask in marks.values()):
        return true, around
    for name, mask in marks.items():
        save_mask(out / "tainted" / f"{name}.png", mask)
    views = [replace(view, hidden=view.hidden | silent[view.camera.name]) for view in around.views]
    return pictures, replace(around, views=views, photos=photos)


def completed_further(params: Params, out: Path, gaussians, new, around):
    """Views put together from pieces of themselves, the one with most that nothing covers first; the Gaussians with
    what they show, the labels, and the views."""
    import numpy as np

    from reffusion.initialize import coverage
    from reffusion.io.images import save_image
    from reffusion.paint import paint2d
    from reffusion.prior import inpaint
    from reffusion.types import Reference

    further: list[Reference] = []
    found = coverage.open_pixels(gaussians, around, around.cameras)
    haze = coverage.haze(gaussians, new, around, found, params.leak)
    gaussians, new = gaussians.map(lambda p: p[~haze]), new[~haze]
    while len(further) < params.further and (camera := coverage.barest(around, found)):
        mask, hidden = found[camera.name], around.hidden[camera.name]
        # Just outside C a photograph may still show the object's rim, which would be repeated.
        rimmed = paint2d.widened(hidden, coverage.RIM)
        base = inpaint.background(gaussians, camera, around.photos[camera.name], rimmed)
        picture = paint2d.exemplar(base, mask | hidden & paint2d.widened(mask, coverage.RIM))
        reference = Reference(camera, picture, mask)
        print(f"further view {camera.name}: {mask.sum() / hidden.sum():.1%} of the mask is covered by nothing")
        try:
            gaussians, new = filled(params, out, gaussians, new, reference, around, None, None, farthest=True)
        except ValueError as error:  # a sliver at the border of a view: others may show it better
            print(f"left as it is: {error}")
            found[camera.name] = np.zeros_like(mask)
            continue
        save_image(out / "further" / f"{camera.name}.png", picture)
        further.append(reference)
        found |= coverage.open_pixels(gaussians, around, [c for c in around.cameras if found[c.name].any()])
    return gaussians, new, further


def settled(params: Params, out: Path, gaussians, references, around):
    """The Gaussians after `params.settle` steps of reconstruction; see `reffusion.initialize.settle`."""
    import shutil

    from reffusion.initialize.settle import Known, settle

    hidden = {view.camera.name: view.hidden for view in around.views}
    work = out / ".settle"  # hidden: its trace tells seconds, which are no part of the artifact's content
    work.mkdir(exist_ok=True)
    done = settle(gaussians, Known(around.cameras, around.photos, hidden, references), params.settle, params.seed, work)
    shutil.rmtree(work)
    return done


def completion(params: Params):
    """How depth is found behind the object."""
    from dataclasses import fields

    from reffusion.depth.behind import Completion

    named = {f.name: getattr(params, f.name) for f in fields(Completion) if f.name != "robust"}
    return Completion(**named, robust=params.depth_align == "robust")


def estimate_of(network, reference):
    """The depth model's answer to the reference, [H, W] disparity up to scale and offset; None without a model."""
    import torch

    from reffusion.depth import monocular

    if network is None:
        return None
    image = torch.from_numpy(reference.image).permute(2, 0, 1) / 255
    return monocular.disparity(network, image).numpy()
