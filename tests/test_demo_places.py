"""The generator's harder scenes: an occluder that remains, a table edge, a corner of two walls, and foliage."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import yaml

from reffusion.io.images import load_mask

pytestmark = [pytest.mark.integration, pytest.mark.slow]
SEEDS = 0, 11


@pytest.mark.parametrize(
    ("name", "mask", "share"),
    [("behind", 0.06, 0.6), ("beside", 0.04, 0.1), ("table", 0.05, 0.05), ("corner", 0.1, 0.4), ("grass", 0.1, 0.5)],
)
def test_harder_places_have_masks_of_the_demos_size(generate, name, mask, share):
    for seed in SEEDS:
        facts = generate._facts(seed, photograph_scene(name, seed)[2])
        assert share <= min(facts["never_seen_share"].values()) < 0.9
        assert mask < facts["mask_share"]["train"] < 0.25


def shrink_kind(kind):
    """Return a scene kind with fewer, tiny photographs (48 x 36 px) and coarser textures."""
    return replace(kind, width=48, height=36, samples=1, train=24, test=6, texture=256, node=0.4, points=60)


@cache
def photograph_scene(name: str, seed: int):
    """Return the solids, the cameras of the training views, and the photographs of a small scene of a kind."""
    from lab.scenes import generate, photographs

    kind = shrink_kind(generate.KINDS[name])
    furniture, target = generate.furnish(seed, kind)
    world = generate.bake(furniture, seed, kind)
    session = photographs.take_photographs(seed, kind, world, target)
    return world.solids, session.cameras[kind.test :], session


def test_what_stays_hides_a_part_of_the_hole_from_the_reference_only(generate):
    from lab.scenes import photographs, raycast

    kind = shrink_kind(generate.KINDS["behind"])
    for seed in SEEDS:
        solids, cameras, session = photograph_scene("behind", seed)
        without = solids._replace(**{f: v[~solids.removable] for f, v in solids._asdict().items()})
        unseen = [
            raycast.surface_points(solids, session.cameras[k], photographs.pixel_centers(session.hidden[k]), False)[0]
            for k in range(kind.test, kind.test + kind.train)
        ]
        seen = np.isfinite(
            raycast.observations(without, cameras, kind.width, kind.height, np.concatenate(unseen))[..., 0]
        )
        reference = session.middle - kind.test
        assert 0.05 < 1 - seen[:, reference].mean() < 0.6
        assert seen.any(1).mean() > 0.99


def test_the_object_hides_a_part_of_a_thing_close_to_it_in_the_reference_view(generate):
    """Four things that stay stand within half the object's radius. Other views show the hidden part."""
    from lab.scenes import photographs, raycast
    from lab.scenes.solids import ROOM

    kind = shrink_kind(generate.KINDS["beside"])
    for seed in SEEDS:
        solids, cameras, session = photograph_scene("beside", seed)
        chest = np.flatnonzero(solids.removable)[0]
        from_chest = np.linalg.norm(solids.center[:, ::2] - solids.center[chest, ::2], axis=1)
        near = np.flatnonzero(
            ~solids.removable & (from_chest < 0.6) & (solids.kind != ROOM) & (solids.half[:, 1] > 0.1)
        )
        assert len(near) == 4
        reference = session.middle - kind.test
        every = photographs.pixel_centers(np.ones((kind.height, kind.width), bool))
        hidden = session.masks[session.middle].ravel()
        _, which = raycast.surface_points(solids, cameras[reference], every, False)
        shares = [hidden[which == thing].mean() for thing in near]
        assert max(shares) > 0.3, shares
        behind = near[int(np.argmax(shares))]
        points, _ = raycast.surface_points(solids, cameras[reference], every[hidden & (which == behind)], False)
        without = solids._replace(**{f: v[~solids.removable] for f, v in solids._asdict().items()})
        seen = np.isfinite(raycast.observations(without, cameras, kind.width, kind.height, points)[..., 0])
        assert seen.sum(1).min() > 1


def test_the_table_stands_in_free_space(generate):
    """Some cameras lie below the table top, the reference camera above; the object overhangs the table's edge."""
    kind = shrink_kind(generate.KINDS["table"])
    solids, cameras, session = photograph_scene("table", 0)
    top = next(n for n in range(len(solids.kind)) if solids.half[n, 1] == 0.02 and not solids.removable[n])
    chest = np.flatnonzero(solids.removable)[0]
    (_, y, z), (_, thick, deep) = solids.center[top], solids.half[top]
    assert cameras[:, 14].min() < y - thick < y + 0.4 < cameras[session.middle - kind.test, 14]
    edge, front = z + deep, solids.center[chest, 2] + solids.half[chest, 2]
    assert edge < front < edge + 0.1 and solids.center[chest, 2] < edge
    assert solids.center[chest, 1] - solids.half[chest, 1] == pytest.approx(y + thick)


def test_behind_the_object_a_corner_makes_a_step(generate):
    """Without the object, the hole of the middle view shows a wall that juts out and a surface far behind it."""
    from lab.scenes import photographs, raycast

    kind = shrink_kind(generate.KINDS["corner"])
    solids, cameras, session = photograph_scene("corner", 0)
    pixels = photographs.pixel_centers(session.masks[session.middle])
    points, which = raycast.surface_points(solids, cameras[session.middle - kind.test], pixels, False)
    wall = next(n for n in range(len(solids.kind)) if solids.half[n, 1] == 1.35 and n > 0)
    back = (which == 0) & (points[:, 1] > 0.01) & (points[:, 2] < 0.01)
    assert (which == wall).mean() > 0.2 and back.mean() > 0.1
    assert points[which == wall, 2].max() > 0.4


def test_a_pair_has_masks_for_each_object_that_make_up_the_hole(generate, tmp_path):
    """The scene has two objects, a box and a ball, and two reference views.

    Every training view has one mask for each object. A pixel where one object occludes the other is in the mask of the
    occluding object only.
    """
    folder = tmp_path / "pair"
    facts = generate.generate(folder, 0, shrink_kind(generate.KINDS["pair"]))
    assert 0.2 <= min(facts["never_seen_share"].values()) and facts["mask_share"]["train"] > 0.05
    boxes, balls = (sorted((folder / f"masks/{name}").iterdir()) for name in ("box", "ball"))
    assert [path.name for path in boxes] == [path.name for path in balls] and len(boxes) == 24
    for box, ball in zip(boxes, balls, strict=True):
        assert load_mask(box).any() and load_mask(ball).any()
    references = yaml.safe_load((folder / "scene.yaml").read_text())["reference"]
    assert len({each["view"] for each in references}) == 2
    assert all((folder / each["image"]).is_file() for each in references)


def test_leaves_are_where_the_rays_meet_them(generate):
    """A ray through foliage stops at the first leaf.

    A second ray, started just before the hit, meets a leaf at the hit or nearer. No camera sees a point just behind
    the leaf.
    """
    from lab.scenes import raycast
    from lab.scenes import solids as solid
    from lab.scenes.furniture import Furniture, Material

    f = Furniture()
    f.room((0, 2, 0), (4, 2, 4), *[Material("white")] * 6)
    f.thicket(0.1, 0.5, 0.2, (0.9, 0.8, 0.7), 0.1, (0.06, 0.09, 0.01, 80), Material("white"), 5, yaw=30)
    thing, _ = f.arrays({"white": 0}, 0.4)
    draw = np.random.default_rng(0)
    centers, aims = draw.uniform(-1, 1, (40, 3)) * [3.5, 1.5, 3.5] + [0, 2, 0], draw.uniform(-0.3, 0.3, (40, 3))
    aims += np.array([0.1, 0.9, 0.2])
    hits = 0
    for center, aim in zip(centers, aims, strict=True):
        way = (aim - center) / np.linalg.norm(aim - center)
        far = solid.distance(thing, 1, *center, *way)
        if far > 1e20:
            continue
        hits += 1
        point = center + far * way
        face, u, v, *normal = solid.surface(thing, 1, *point)
        assert face == 6 and 0 <= u <= 0.9 and 0 <= v <= 0.8
        assert np.linalg.norm(normal) == pytest.approx(1) and np.dot(normal, way) < 0
        # From 0.02 before the hit, the ray meets this leaf or a nearer leaf. The leaf hides the point 0.02 behind.
        assert solid.distance(thing, 1, *(point - 0.02 * way), *way) <= 0.02 + 1e-9
        camera = np.array([1, 0, 0, 0, *np.eye(3).ravel(), *center])
        assert not raycast._reaches(thing, camera, True, *(point + 0.02 * way))
    assert hits > 20
