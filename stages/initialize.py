"""initialize: masked Gaussians out; the references' pixels, on completed depth, in as new masked Gaussians."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from reffusion import morphology, seeding, trace
from reffusion.background import unobserved
from reffusion.depth import background_depth, billboard, monocular
from reffusion.depth.background_depth import Completion
from reffusion.fit import exposure
from reffusion.gaussians.sheets import Sheets
from reffusion.initialize import coverage, random_init, relighting, sharing, unprojection
from reffusion.initialize.refit import Known, settle
from reffusion.initialize.sds_gain import Gain, estimated
from reffusion.inpaint import classical, exemplar, feedforward
from reffusion.io.arrays import load_json, load_labels, save_json, save_labels
from reffusion.io.images import save_exr, save_image, save_mask
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import load_mask_sets, load_object, load_references, load_scene
from reffusion.masks import regions, voting
from reffusion.params.initialize import Params
from reffusion.prior import inpaint
from reffusion.splat import rasterizer
from reffusion.types import Reference
from reffusion.weights import painters
from reffusion.weights.published import PAINTERS

WARN_FROM = 0.01  # share of C that shows nothing, from which a view is named
LEAK = 1.0  # weight in undecided over other pixels from which Gaussians are haze
LITTLE = 0.9  # share of what was open in a view that may still be when it is completed
OVERLAP = 0.006  # of the image's width: how far new Gaussians reach beyond the hole
COVERED = 0.9  # alpha below which the reference also fills pixels of C
SEEN_THROUGH = 0.5  # alpha in C of any view below which there is a gap to fill
HOW = Completion()  # how depth is found behind the object
SEED = 0  # of the draws that find planes, of settling, and of Gaussians at random


def run(
    params: Params, out: Path, *, poses: Path, fit: Path, masks: Path, reference: Path | None, lift: Path | None = None
) -> None:
    gaussians = load_ply(fit / "gaussians.ply").map(lambda p: p.to(params.device))
    labels = load_labels(masks / "labels.npy").to(params.device)
    if len(labels) != len(gaussians):
        raise ValueError(f"{masks}: {len(labels)} labels for {len(gaussians)} Gaussians of {fit}: run masks again")
    scene = load_scene(poses)
    if params.start == "lift" and lift is None:
        raise ValueError("initialize.start is 'lift', but the stage lift was left out: set distill.lift.weight")
    completed = {"reference": reference, "lift": lift}.get(params.start)
    references = load_references(completed, scene) if completed else []
    network = monocular.load_network(params.depth.model, params.device) if params.depth.model and references else None
    sets = load_mask_sets(masks, scene.cameras)
    thing = load_object(masks).to(params.device)
    around = surroundings(params, scene, gaussians, thing, sets, poses, fit) if references else None
    removed = gaussians.map(lambda p: p[thing])
    gaussians = gaussians.map(lambda p: p[~labels])
    new = torch.zeros(len(gaussians), dtype=torch.bool, device=params.device)
    train = [scene.cameras[name] for name in scene.train]
    haze = torch.zeros_like(new)
    if params.tidy and params.start != "nothing":  # where nothing is put in its place, haze is better than a black hole
        haze = voting.leaking(gaussians, train, {c.name: sets[c.name].undecided for c in train}, LEAK)
    gaussians, new = gaussians.map(lambda p: p[~haze]), new[~haze]
    if references:
        best = load_json(masks / "facts.json")["best_reference"]
        gaussians, new = from_references(params, out, gaussians, new, references, best, around, network)
    if references and params.start == "reference":
        sets = narrowed(out, gaussians, new, sets, around.cameras)
    true = true_pictures(reference, references, around) if references and params.start == "reference" else []
    if true and params.settle:
        true, around, marks = relighting.without_shadows(true, gaussians, around)
        for name, mask in marks.items():
            save_mask(out / "tainted" / f"{name}.png", mask)
    further = []
    if true and params.further:
        gaussians, new, further = completed_further(params, out, gaussians, new, around, true)
        true += further
    if params.start == "random" and any(each.invent.any() for each in sets.values()):
        added = at_random(params, removed, gaussians, scene, sets, masks)
        gaussians = gaussians.zipped(added, lambda a, b: torch.cat([a, b]))
        new = torch.cat([new, new.new_ones(len(added))])
    if true and params.settle:
        drawn_there = {name: each.invent & (name not in scene.clean) for name, each in sets.items()}
        shown = replace(around, cameras=[camera for camera in around.cameras if camera.name not in scene.blank])
        exact = new & all(each.depth is not None for each in references)
        gaussians = settled(params, out, gaussians, exact, true, shown, drawn_there)
    save_ply(out / "gaussians.ply", gaussians)
    save_labels(out / "labels.npy", new.cpu())
    uncovered = {each.name: unprojection.uncovered(gaussians, each, sets[each.name].consistent) for each in train}
    facts = {"new_gaussians": int(new.sum()), "removed_gaussians": int(labels.sum()), "haze": int(haze.sum())}
    facts |= {"completed": [each.camera.name for each in true], "uncovered": uncovered}
    shares = {each.camera.name: float(each.mask.sum() / sets[each.camera.name].consistent.sum()) for each in further}
    facts |= {"further": shares} | sds_facts(params, gaussians, train, sets, around, max(shares.values(), default=0.0))
    facts["uncovered_share"] = sum(uncovered.values()) / max(len(uncovered), 1)
    save_json(out / "facts.json", facts)
    if bare := [f"{name} ({share:.1%})" for name, share in uncovered.items() if share > WARN_FROM]:
        print(f"uncovered in {len(bare)} views: {', '.join(bare)}: complete another view and add it to the references")


def sds_facts(params: Params, gaussians, train, sets, around, guessed: float) -> dict:
    """What SDS may add to the initialization; only one from references is told."""
    if around is not None and params.start == "reference":
        gain = estimated(gaussians, train, sets, around.photos, guessed)
    else:
        gain = Gain(True, f"start is {params.start}", None)
    print(f"SDS {'may' if gain.may else 'cannot'} gain: {gain.says}")
    return {"sds_may_gain": gain.may, "sds_says": gain.says, "beside_psnr": gain.beside}


def surroundings(params: Params, scene, gaussians, thing, sets, poses: Path, fit: Path):
    """What the photographs say of the space around the object, and the planes that go on into what they do not."""
    hidden = {name: each.consistent & (name not in scene.clean) for name, each in sets.items()}
    train = [scene.cameras[name] for name in (*scene.train, *scene.blank)]
    photos = exposure.load_views(poses, fit, scene.train)
    for name in scene.blank:  # the Gaussians' own picture; what no photograph shows of it is hidden
        everything = np.ones_like(hidden[name])
        photos[name] = inpaint.background(gaussians, scene.cameras[name], np.zeros((1, 1, 3), np.uint8), everything)
    found = exemplar.looked_around(gaussians, thing, train, hidden, photos, scene.points, SEED)
    consistent = {name: each.consistent for name, each in sets.items()}
    unknown = {name: each.undecided for name, each in sets.items()}
    place = (found.planes, scene.points, found.centre, found.radius, found.mirrors)
    return unprojection.Surroundings(train, consistent, photos, found.views, *place, unknown, frozenset(scene.blank))


def at_random(params: Params, removed, remaining, scene, sets, masks: Path):
    """Gaussians at random in the region of the hole: that of the removed ones, or the box that the scene names."""
    region, train = load_json(masks / "facts.json").get("region"), [scene.cameras[name] for name in scene.train]
    if region:
        box = random_init.box_around(region["center"], region["size"])
    elif len(removed):
        box = random_init.box_of(removed.means.double().cpu().numpy())
    else:
        raise ValueError("initialize.start is 'random', but no Gaussian was removed: nothing says where the hole is")
    invents = {camera.name: sets[camera.name].invent for camera in train if sets[camera.name].invent.any()}
    count = max(len(removed), random_init.FEWEST)
    points = random_init.points_in(box, count, train, invents, seeding.generator(SEED, "initialize", "random"))
    draw = seeding.generator(SEED, "initialize", "random colours")
    added = random_init.gaussians_at(points, remaining.sh.shape[1], remaining.antialiased, draw)
    return added.map(lambda p: p.to(params.device))


def from_references(params: Params, out: Path, gaussians, new, references, best, around, network):
    """The Gaussians with those of the references, the `best` first, and the labels."""
    log, shares = trace.Trace(out), {}
    holes = [each for each in references if each.mask.any()]
    holes.sort(key=lambda r: (r.camera.name != best, -int(r.mask.sum())))
    if params.tidy:
        shares = sharing.shares(gaussians, holes, around, HOW)
    for each in holes:
        share = shares.get(each.camera.name)
        gaussians, new = filled(params, out, gaussians, new, each, around, network, log, share=share)
    return gaussians, new


def filled(params: Params, out: Path, gaussians, new, reference, around, network, log, farthest=False, share=None):
    """The Gaussians with those of one reference, on what is still empty in its mask, or its share; and the labels."""
    camera, hidden = reference.camera, around.hidden[reference.camera.name]
    stays = reference.mask & ~hidden  # what is put in there has a shine of its own; and a sliver tells nothing of it
    sheets = Sheets(gloss=params.gloss and not farthest and not stays.any())
    hole = unprojection.to_fill(gaussians, new, reference, hidden, COVERED)
    if farthest and around.mirrors:
        hole |= reference.mask  # also where something lies there, but behind a mirror image
    remaining = gaussians.map(lambda p: p[~new])
    # A gap that is left open at last is too narrow for the comparison to tell of its rim.
    swept = params.depth.sweep and not (farthest and coverage.narrow(hole))
    near, told = around.compared(camera, hole) if swept else (around, None)
    onward = unobserved.behind(remaining, camera, hidden, near.views, near.planes, near.mirrors)
    past = (lambda depth: near.looked_past(camera, depth)) if params.depth.sweep else None
    hints = background_depth.Hints(
        onward.continued, onward.planes, onward.witnessed, near.photographed(camera), told, past
    )
    estimate = estimate_of(network, reference)
    depth, made_up, said = unprojection.depth_behind(
        remaining, reference, hole, hidden, around.points, HOW, estimate, log, hints, farthest
    )
    drawn_over = over = np.zeros_like(hole)
    leaves = share.leaves if share else drawn_over
    if stays.any():
        shown = rasterizer.render(remaining, camera, sh_degree=0).depth.double().cpu().numpy()
        behind_it, drawn_over = np.where(shown > 0, shown, depth), hole & stays
        if reference.depth is None and estimate is None:
            stands = billboard.standing(drawn_over, behind_it, camera)
            depth, made_up = (np.where(drawn_over, stands, each) for each in (depth, made_up))
            said = f"{said}; a billboard, good within {billboard.GOOD_WITHIN} degrees, stands where the scene goes on"
        else:
            back = share.draws if share else coverage.before(gaussians, made_up, reference, hidden) & ~hole
            drawn_over, depth = drawn_over & ~leaves | back, np.where(back, made_up, depth)
        over = drawn_over & ~coverage.beside_edges(depth, behind_it)
    print(f"depth of reference {camera.name}: {said}")
    save_exr(out / "depth" / f"{camera.name}.exr", depth.astype("float32"))
    pixels = background_depth.grown(hole & ~drawn_over & ~leaves, OVERLAP) & ~leaves | over
    gaussians, new = unprojection.placed(gaussians, new, reference, depth, pixels, around, sheets)
    if farthest or not params.tidy:  # what is open still is asked for view by view, or left
        return gaussians, new
    views = [(each, around.hidden[each.name]) for each in around.cameras]
    gap = unprojection.seen_through(gaussians, camera, made_up, hidden & ~pixels, views, SEEN_THROUGH)
    if not gap.any():
        return gaussians, new
    return unprojection.placed(gaussians, new, reference, made_up, gap, around, sheets)


def narrowed(out: Path, gaussians, new, sets, cameras):
    """The masks with I where the references drew something. Writes invent/<view>.png where that is less than it was."""
    less = {}
    for camera in cameras:
        each = sets[camera.name]
        if (each.invent & ~each.consistent).any():
            shown = voting.label_view(gaussians, new, camera)
            less[camera.name] = replace(each, invent=regions.where_drawn(each.invent, each.consistent, shown))
            save_mask(out / "invent" / f"{camera.name}.png", less[camera.name].invent)
    return sets | less


def true_pictures(reference: Path, references: list, around) -> list:
    """The references, each standing for all of which it knows more than the Gaussians do: a picture that the scene
    brings for all of C, one that was completed here for what was invented."""
    facts = reference / "facts.json"
    given = load_json(facts)["given"] if facts.exists() else []
    whole = lambda each: replace(each, mask=each.mask | around.hidden[each.camera.name])
    return [whole(each) if each.camera.name in given else each for each in references]


def completed_further(params: Params, out: Path, gaussians, new, around, true):
    """Views put together from patches of the photographs and of the `true` pictures, or painted, the one with most that
    nothing covers first; the Gaussians with what they show, the labels, and the views."""
    further: list[Reference] = []
    images = coverage.mirrored(around)
    found = coverage.open_pixels(gaussians, new, around, around.cameras, images)
    haze = coverage.haze(gaussians, new, around, found, LEAK)
    gaussians, new = gaussians.map(lambda p: p[~haze]), new[~haze]
    looked = replace(around.looked(), completed=coverage.completed(true, gaussians, around))
    cameras, kind = coverage.beside_photographs(around), painters.resolve_inpainter(params.inpainter)
    painter = feedforward.load(kind, "", params.device) if kind in PAINTERS else None
    while len(further) < params.further and (camera := coverage.barest(cameras, around, found)):
        mask, hidden = found[camera.name], around.hidden[camera.name]
        # Just outside C a photograph may still show the object's rim, which would be repeated.
        rimmed = morphology.widened(hidden, exemplar.RIM)
        base = inpaint.background(gaussians, camera, around.photos[camera.name], rimmed)
        hole = exemplar.with_rim(mask, hidden)
        if painter is not None:
            picture = painter.paint(base, hole)
        elif coverage.narrow(mask):  # in a gap there is no room for texture, only for what is beside it
            picture = classical.telea(base, hole)
        else:
            picture = exemplar.completions(base, hole, camera, hidden, looked, [SEED])[0].image
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
        bare = [each for each in cameras if found[each.name].any()]
        found |= coverage.open_pixels(gaussians, new, around, bare, images)
        if found[camera.name].sum() > LITTLE * mask.sum():  # once more would find as little
            found[camera.name] = np.zeros_like(mask)
    return gaussians, new, further


def settled(params: Params, out: Path, gaussians, exact, references, around, drawn_there):
    """The Gaussians after `params.settle` steps of reconstruction; see `reffusion.initialize.refit`.

    `exact`: [N] bool, whose depth references brought. `drawn_there`: view name -> bool [H, W], where something is to be
    drawn that no photograph shows.
    """
    hidden = {view.camera.name: view.hidden | drawn_there[view.camera.name] for view in around.views}
    work = out / ".settle"  # hidden: its trace tells seconds, which are no part of the artifact's content
    work.mkdir(exist_ok=True)
    known = Known(around.cameras, around.photos, hidden, [each for each in references if each.mask.any()])
    done = settle(gaussians, exact, known, params.settle, SEED, work)
    shutil.rmtree(work)
    return done


def estimate_of(network, reference):
    """The depth model's answer to the reference, [H, W] disparity up to scale and offset; None without a model."""
    if network is None:
        return None
    image = torch.from_numpy(reference.image).permute(2, 0, 1) / 255
    return monocular.disparity(network, image).numpy()
