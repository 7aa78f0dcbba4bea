"""From every layout to a scene: cameras, lenses, masks, splits, frames; and what is refused."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from reffusion import frame, io, lens
from reffusion.io import colmap
from reffusion.types import Gaussians
from stages import poses

CAPTURES = Path(__file__).parents[2] / "shared" / "data"
WIDTH, HEIGHT = 96, 72
FISHEYE = ("OPENCV_FISHEYE", (60.0, 61.0, 48.5, 35.0, 0.02, -0.01, 0.002, 0.001))
OPENCV = ("OPENCV", (90.0, 91.0, 47.0, 36.5, 0.06, -0.08, -0.001, 0.002))
RADIAL = ("SIMPLE_RADIAL", (90.0, 48.0, 36.0, 0.05))
PINHOLE = ("SIMPLE_PINHOLE", (90.0, 48.0, 36.0))


@dataclass(frozen=True)
class Truth:
    """A made-up capture in its own frame: view name -> [4, 4], points, the lens at the size of the pictures."""

    world_to_camera: dict[str, np.ndarray]
    points: np.ndarray
    model: tuple[str, tuple[float, ...]]

    @property
    def lens(self) -> lens.Lens:
        return lens.from_colmap(self.model[0], WIDTH, HEIGHT, self.model[1])


def some_truth(model=PINHOLE, views=6, scale=1.0, offset=(0.0, 0.0, 0.0)) -> Truth:
    """Cameras on an arc, 4 away from a cloud of points around the offset."""
    generator, cameras, offset = np.random.default_rng(3), {}, np.array(offset)
    for k in range(views):
        angle = np.radians(-25 + 50 * k / (views - 1))
        center = 4 * np.array([np.sin(angle), 0.15 * generator.normal(), -np.cos(angle)])
        forward = -center / np.linalg.norm(center)
        right = np.cross([0.0, 1.0, 0.1 * generator.normal()], forward)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        pose[:3, 3] = -pose[:3, :3] @ (scale * center + offset)
        cameras[f"v{k:02d}"] = pose
    return Truth(cameras, generator.uniform(-0.9, 0.9, (60, 3)) * scale + offset, model)


def write_pictures(folder: Path, names, size=(WIDTH, HEIGHT), ending=".png") -> None:
    for k, name in enumerate(names):
        io.save_image(folder / f"{name}{ending}", np.full((size[1], size[0], 3), 40 + k, np.uint8))


def write_masks(folder: Path, names, size=(WIDTH, HEIGHT), value=255) -> None:
    mask = np.zeros((size[1], size[0]), np.uint8)
    mask[size[1] // 4 : size[1] // 2, size[0] // 4 : size[0] // 2] = value
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        Image.fromarray(mask).save(folder / f"{name}.png")


def write_model(folder: Path, truth: Truth, text=False, factor=1, ending=".jpg") -> None:
    """A COLMAP model for pictures `factor` times larger than those written."""
    at = truth.lens.resized(WIDTH * factor, HEIGHT * factor)
    single = truth.model[0].startswith(("SIMPLE", "RADIAL"))
    head = (at.fx, at.cx, at.cy) if single else (at.fx, at.fy, at.cx, at.cy)
    params = (*head, *truth.model[1][len(head) :])
    cameras = {1: colmap.ModelCamera(truth.model[0], at.width, at.height, params)}
    images = {
        k: colmap.ModelImage(name + ending, 1, pose)
        for k, (name, pose) in enumerate(sorted(truth.world_to_camera.items(), reverse=True), start=7)
    }
    colors = np.full((len(truth.points), 3), 99, np.uint8)
    colmap.save_model(folder, cameras, images, truth.points, colors)
    if text:
        import pycolmap

        pycolmap.Reconstruction(folder).write_text(folder)
        for path in folder.glob("*.bin"):
            path.unlink()


def write_transforms(folder: Path, truth: Truth, per_frame=False, **changes) -> None:
    at, flip = truth.lens, np.diag([1.0, -1.0, -1.0, 1.0])
    values = {"w": WIDTH, "h": HEIGHT, "fl_x": at.fx, "fl_y": at.fy, "cx": at.cx, "cy": at.cy}
    values |= {f"k{i}": k for i, k in enumerate(at.radial, start=1)} | dict(
        zip(("p1", "p2"), at.tangential, strict=True)
    )
    values["camera_model"] = truth.model[0]
    frames = [
        {"file_path": f"images/{name}.png", "transform_matrix": (np.linalg.inv(pose) @ flip).tolist()}
        for name, pose in sorted(truth.world_to_camera.items(), reverse=True)
    ]
    record = {"frames": [f | values for f in frames]} if per_frame else {**values, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(record | changes))


def write_poses_bounds(folder: Path, truth: Truth, factor=4) -> None:
    rows = []
    for pose in (truth.world_to_camera[name] for name in sorted(truth.world_to_camera)):
        right, down, forward = pose[:3, :3]
        size = np.array([HEIGHT * factor, WIDTH * factor, truth.lens.fx * factor])
        matrix = np.stack([down, right, -forward, -pose[:3, :3].T @ pose[:3, 3], size], axis=1)
        z = truth.points @ forward + pose[2, 3]
        rows.append([*matrix.ravel(), z.min(), z.max()])
    np.save(folder / "poses_bounds.npy", np.array(rows))


def prepare(folder: Path, layout: str, truth: Truth) -> Path:
    """Pictures, masks and poses in one of the layouts."""
    images = folder / ("images_4" if layout.startswith("llff") else "images")
    write_pictures(images, truth.world_to_camera)
    write_masks(images / "label" if layout.startswith("llff") else folder / "masks", truth.world_to_camera)
    if layout.startswith("llff"):
        write_poses_bounds(folder, truth)
    if layout in ("llff+bin", "llff+txt", "colmap", "colmap txt"):
        write_model(folder / "sparse" / "0", truth, layout.endswith("txt"), 4 if layout.startswith("llff") else 1)
    if layout.startswith("transforms"):
        write_transforms(folder, truth, layout.endswith("each"))
    return folder


def run(folder: Path, **params):
    out = folder.parent / (folder.name + "_out")
    out.mkdir(exist_ok=True)
    poses.run(poses.Params(**params), out, scene=folder)
    return io.load_scene(out), out


def reprojection_error(scene, truth: Truth) -> float:
    """Pixels between where a point is in the photograph and where the undistorted picture reads it from."""
    worst = 0.0
    for name, pose in truth.world_to_camera.items():
        at = truth.points @ pose[:3, :3].T + pose[:3, 3]
        shown = lens.to_pixels(at[:, :2] / at[:, 2:], truth.lens)
        camera = scene.cameras[name]
        ours = scene.similarity.apply(truth.points) @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        uv = (ours[:, :2] / ours[:, 2:] * (camera.fx, camera.fy)) + (camera.cx, camera.cy)
        back = (uv - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        worst = max(worst, float(np.abs(lens.to_pixels(back, truth.lens) - shown).max()))
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    return worst


@pytest.mark.parametrize("model", [PINHOLE, RADIAL, OPENCV, FISHEYE], ids=lambda m: m[0])
@pytest.mark.parametrize("layout", ["llff+bin", "llff+txt", "colmap", "colmap txt", "transforms", "transforms each"])
def test_every_layout_keeps_the_projection(tmp_path, layout, model):
    truth = some_truth(model, scale=7.0, offset=(100.0, -30.0, 5.0))
    scene, out = run(prepare(tmp_path / "s", layout, truth))
    assert reprojection_error(scene, truth) < 1e-3
    assert sorted(scene.cameras) == sorted(truth.world_to_camera) == list(scene.train) and not scene.test
    assert len(io.load_raw_masks(out, scene.train)) == 6
    if layout.startswith(("llff", "colmap")):
        np.testing.assert_allclose(scene.similarity.invert(scene.points[:60]), truth.points, atol=1e-9)


def test_llff_alone_keeps_the_projection(tmp_path):
    truth = some_truth()
    scene, _ = run(prepare(tmp_path / "s", "llff", truth))
    assert reprojection_error(scene, truth) < 1e-3
    assert len(scene.points) == 10_000  # drawn between the bounds


def test_the_models_poses_win_over_poses_bounds(tmp_path):
    truth = some_truth(RADIAL)
    folder = prepare(tmp_path / "s", "llff+bin", truth)
    rows = np.load(folder / "poses_bounds.npy")
    rows[:, 3] += 0.1
    np.save(folder / "poses_bounds.npy", rows)
    assert reprojection_error(run(folder)[0], truth) < 1e-3


def test_llff_copies_renamed_by_number_are_matched_in_order(tmp_path):
    truth = some_truth()
    write_pictures(tmp_path / "s" / "images_4", [f"image{k:03d}" for k in range(6)])
    write_masks(tmp_path / "s" / "images_4" / "label", [f"image{k:03d}" for k in range(6)])
    write_model(tmp_path / "s" / "sparse" / "0", truth, factor=4)
    write_poses_bounds(tmp_path / "s", truth)
    scene, _ = run(tmp_path / "s")
    renamed = {f"image{k:03d}": truth.world_to_camera[f"v{k:02d}"] for k in range(6)}
    assert reprojection_error(scene, replace(truth, world_to_camera=renamed)) < 1e-3


@pytest.mark.parametrize("shifted", [False, True])
def test_points_without_images_bin_are_taken_only_in_the_right_frame(tmp_path, shifted):
    truth = some_truth()
    folder = prepare(tmp_path / "s", "llff+bin", truth)
    (folder / "sparse/0/images.bin").unlink()
    if shifted:
        records = replace(truth, points=truth.points + np.array([30.0, 0.0, 0.0]))
        write_model(folder / "sparse" / "0", records, factor=4)
        (folder / "sparse/0/images.bin").unlink()
        with pytest.warns(UserWarning, match=r"points3D\.bin.*not in the frame"):
            scene, _ = run(folder)
        assert len(scene.points) == 10_000
    else:
        scene, _ = run(folder, least_points=0)
        np.testing.assert_allclose(scene.similarity.invert(scene.points), truth.points, atol=1e-9)


def splat_dots(truth: Truth, name: str) -> np.ndarray:
    """The view of a grid of soft dots on a plane, through the lens; uint8 [H, W, 3], and the dots' directions."""
    pose = truth.world_to_camera[name]
    grid = np.stack(np.meshgrid(np.linspace(-1.2, 1.2, 5), np.linspace(-0.9, 0.9, 4), [0.0]), -1).reshape(-1, 3)
    at = grid @ pose[:3, :3].T + pose[:3, 3]
    directions = at[:, :2] / at[:, 2:]
    shown = lens.to_pixels(directions, truth.lens)
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    squares = (columns[..., None] - shown[:, 0]) ** 2 + (rows[..., None] - shown[:, 1]) ** 2
    image = 230.0 * np.exp(-squares / (2 * 1.2**2)).sum(axis=2)
    return np.repeat(np.clip(image, 0, 255).astype(np.uint8)[..., None], 3, 2), directions


@pytest.mark.parametrize("model", [RADIAL, OPENCV, FISHEYE], ids=lambda m: m[0])
def test_a_dot_grid_undistorts_onto_the_pinhole(tmp_path, model):
    truth = some_truth(model)
    folder = prepare(tmp_path / "s", "colmap", truth)
    directions = {}
    for name in truth.world_to_camera:
        image, directions[name] = splat_dots(truth, name)
        io.save_image(folder / "images" / f"{name}.png", image)
    scene, out = run(folder)
    found = 0
    for name, image in io.load_views(out, scene.train).items():
        camera = scene.cameras[name]
        for u, v in directions[name] * (camera.fx, camera.fy) + (camera.cx, camera.cy):
            left, top = int(u) - 2, int(v) - 2
            patch = image[max(top, 0) : top + 5, max(left, 0) : left + 5, 0].astype(float)
            if patch.shape != (5, 5) or top < 0 or left < 0:
                continue
            # Moments of a window are biased by its edge; the logarithm of a Gaussian is a paraboloid.
            rows, columns = np.mgrid[top : top + 5, left : left + 5] + 0.5
            inside = patch > 40
            design = np.stack([columns, rows, columns**2, rows**2, columns * rows, np.ones_like(rows)], -1)[inside]
            a, b, c, d, e, _ = np.linalg.lstsq(design, np.log(patch[inside]), rcond=None)[0]
            peak = np.linalg.solve([[2 * c, e], [e, 2 * d]], [-a, -b])
            assert np.abs(peak - (u, v)).max() < 0.1
            found += 1
    assert found > 80


def test_masks_follow_the_image_through_the_lens(tmp_path):
    truth = some_truth(OPENCV)
    folder = prepare(tmp_path / "s", "colmap", truth)
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    image = np.uint8(128 + 120 * np.sin(columns / 6) * np.sin(rows / 5))
    for name in truth.world_to_camera:
        io.save_image(folder / "images" / f"{name}.png", np.repeat(image[..., None], 3, 2))
        io.save_mask(folder / "masks" / f"{name}.png", image >= 160)
    scene, out = run(folder)
    images, masks = io.load_views(out, scene.train), io.load_raw_masks(out, scene.train)
    for name in scene.train:
        difference = (images[name][..., 0] >= 160) ^ masks[name]
        assert difference.sum() < 0.04 * masks[name].sum()


@pytest.mark.parametrize("model", [RADIAL, OPENCV, FISHEYE], ids=lambda m: m[0])
def test_no_border_is_left_and_little_is_cropped(model):
    whole = lens.from_colmap(model[0], WIDTH, HEIGHT, model[1])
    where = lens.sampling_map(whole, lens.without_distortion(whole))
    assert where.min() >= 0 and (where <= (WIDTH, HEIGHT)).all()
    touches = (
        where[:, 0, 0].min(),
        where[0, :, 1].min(),
        WIDTH - where[:, -1, 0].max(),
        HEIGHT - where[-1, :, 1].max(),
    )
    assert min(touches) < 1.0


@pytest.mark.parametrize(
    "model",
    [
        PINHOLE,
        RADIAL,
        OPENCV,
        FISHEYE,
        ("PINHOLE", (90.0, 92.0, 47.0, 36.0)),
        ("RADIAL", (90.0, 47.0, 36.0, 0.05, -0.02)),
        ("FULL_OPENCV", (90.0, 91.0, 47.0, 36.0, 0.06, -0.08, -0.001, 0.002, 0.01, 0.02, -0.01, 0.003)),
        ("SIMPLE_RADIAL_FISHEYE", (60.0, 47.0, 36.0, 0.02)),
        ("RADIAL_FISHEYE", (60.0, 47.0, 36.0, 0.02, -0.01)),
    ],
    ids=lambda m: m[0],
)
def test_lenses_agree_with_colmap(model):
    import pycolmap

    ours = lens.from_colmap(model[0], WIDTH, HEIGHT, model[1])
    theirs = pycolmap.Camera(model=model[0], width=WIDTH, height=HEIGHT, params=model[1])
    directions = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 2))
    pixels = lens.to_pixels(directions, ours)
    np.testing.assert_allclose(pixels, theirs.img_from_cam(np.c_[directions, np.ones(200)]), atol=1e-10)
    np.testing.assert_allclose(lens.to_directions(pixels, ours), directions, atol=1e-12)
    np.testing.assert_allclose(lens.to_pixels(np.zeros(2), ours), (ours.cx, ours.cy))


def test_a_lens_that_folds_over_is_refused():
    with pytest.raises(ValueError, match="cannot be undone"):
        lens.without_distortion(lens.from_colmap("SIMPLE_RADIAL", WIDTH, HEIGHT, (40.0, 48.0, 36.0, -0.5)))
    with pytest.raises(ValueError, match="FOV"):
        lens.from_colmap("FOV", WIDTH, HEIGHT, (40.0, 40.0, 48.0, 36.0, 0.9))


def spin_nerf(folder: Path, mask_value=1, label_size=(WIDTH, HEIGHT)) -> Truth:
    """The first 2 of 6 views are test views without the object."""
    truth = some_truth(RADIAL)
    names = sorted(truth.world_to_camera)
    write_pictures(folder / "images_4", names)
    write_masks(folder / "images_4" / "label", names[2:], value=mask_value)
    write_masks(folder / "images_4" / "test_label", ["out_00000", "out_00001"], label_size)
    write_poses_bounds(folder, truth)
    write_model(folder / "sparse" / "0", truth, factor=4)
    return truth


@pytest.mark.parametrize("mask_value", [1, 255])
def test_spin_nerf_split_and_masks(tmp_path, mask_value):
    spin_nerf(tmp_path / "s", mask_value, (WIDTH, HEIGHT + 3))
    scene, out = run(tmp_path / "s")
    assert scene.test == ("v00", "v01") and scene.train == ("v02", "v03", "v04", "v05")
    assert sorted(io.load_raw_masks(out, scene.cameras)) == list(scene.train)
    labels = io.load_test_masks(out)
    assert sorted(labels) == ["v00", "v01"]
    for mask in (*labels.values(), *io.load_raw_masks(out, scene.train).values()):
        assert mask.shape == (HEIGHT, WIDTH) and 0.04 < mask.mean() < 0.1
    assert set(np.unique(np.array(Image.open(out / "masks" / "v02.png")))) == {0, 255}


def test_spin_nerf_with_a_missing_training_mask(tmp_path):
    spin_nerf(tmp_path / "s")
    (tmp_path / "s/images_4/label/v04.png").unlink()
    with pytest.warns(UserWarning, match="1 training views have no mask: v04"):
        scene, out = run(tmp_path / "s")
    assert scene.test == ("v00", "v01") and "v04" in scene.train
    assert "v04" not in io.load_raw_masks(out, scene.train)


def test_splits_from_scene_yaml(tmp_path):
    prepare(tmp_path / "s", "transforms", some_truth(views=9))
    scene, out = run(tmp_path / "s", test="every 4", clean=["v01"])
    assert scene.test == ("v00", "v04", "v08") and len(scene.train) == 6 and scene.clean == {"v01"}
    assert sorted(io.load_test_masks(out)) == list(scene.test)  # the object is in these views
    scene, _ = run(tmp_path / "s", train=["v03", "v01", "v02.png"], test=["v05"])
    assert scene.train == ("v01", "v02", "v03") and scene.test == ("v05",) and len(scene.cameras) == 4


def test_frames_without_a_picture_are_named_in_one_warning(tmp_path):
    prepare(tmp_path / "s", "transforms", some_truth())
    for name in ("v01", "v03"):
        (tmp_path / "s" / "images" / f"{name}.png").unlink()
    with pytest.warns(UserWarning) as caught:
        scene, _ = run(tmp_path / "s")
    assert [str(w.message) for w in caught if "no picture" in str(w.message)] == [
        "2 of the 6 frames in transforms.json have no picture: images/v01.png, images/v03.png"
    ]
    assert len(scene.cameras) == 4


def test_transforms_variants(tmp_path):
    truth = some_truth()
    folder = prepare(tmp_path / "s", "transforms", truth)
    record = json.loads((folder / "transforms.json").read_text())
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model"):
        del record[key]
    record["camera_angle_x"] = 2 * np.arctan(WIDTH / 2 / truth.lens.fx)
    for each in record["frames"]:
        each["file_path"] = "./" + each["file_path"].removesuffix(".png")
    record["ply_file_path"], record["applied_transform"] = "some.ply", [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
    (folder / "transforms.json").write_text(json.dumps(record))
    io.save_points(folder / "some.ply", truth.points, np.zeros((60, 3), np.uint8))
    scene, _ = run(folder, least_points=0)
    assert reprojection_error(scene, truth) < 1e-3
    np.testing.assert_allclose(scene.similarity.invert(scene.points), truth.points, atol=1e-9)


def test_large_pictures_are_brought_to_the_longest_side(tmp_path):
    truth = some_truth(OPENCV)
    folder = prepare(tmp_path / "s", "colmap", truth)
    scene, out = run(folder, longest=48)
    assert io.image_size(out / "images" / "v00.png") == (48, 36)
    big = replace(scene, cameras={n: c.resized(WIDTH, HEIGHT) for n, c in scene.cameras.items()})
    assert reprojection_error(big, truth) < 1e-3
    assert io.load_raw_masks(out, ["v00"])["v00"].shape == (36, 48)


@pytest.mark.parametrize("brings", ["points", "bounds", "nothing"])
def test_normalisation_knows_no_units_and_no_offset(tmp_path, brings):
    """A scene a thousand times larger, a million extents away, has the same normalised numbers."""
    found = []
    for k, (scale, offset) in enumerate([(1.0, (0.0, 0.0, 0.0)), (1000.0, (4e9, -3e9, 1e9))]):
        truth = some_truth(scale=scale, offset=offset)
        layout = {"points": "colmap", "bounds": "llff", "nothing": "transforms"}[brings]
        found.append(run(prepare(tmp_path / f"s{k}", layout, truth), least_points=0)[0])
    for name, camera in found[0].cameras.items():
        np.testing.assert_allclose(found[1].cameras[name].world_to_camera, camera.world_to_camera, atol=2e-6)
    centers = np.stack([camera.center for camera in found[0].cameras.values()])
    assert np.linalg.norm(centers, axis=1) == pytest.approx(1.0, abs=0.15)
    assert found[0].similarity.scale == pytest.approx(1000 * found[1].similarity.scale, rel=1e-6)


def test_depth_falls_back_where_nothing_tells_it():
    poses_along = np.stack([np.eye(4)] * 4)
    poses_along[:, 0, 3] = np.arange(4.0)
    pinholes = [lens.Lens(10, 10, 10.0, 10.0, 5.0, 5.0)] * 4
    nothing = np.zeros((0, 3))
    ranges = frame.depth_ranges(poses_along, pinholes, nothing, None)
    assert (ranges > 0).all() and np.allclose(ranges[:, 1], 3 * np.std(np.arange(4.0)))
    with pytest.raises(ValueError, match="nothing tells"):
        frame.depth_ranges(np.stack([np.eye(4)] * 4), pinholes, nothing, None)


def test_random_points_are_seen_seeded_and_coloured(tmp_path):
    truth = some_truth()
    folder = prepare(tmp_path / "s", "transforms", truth)
    scene, _ = run(folder, random_points=500)
    again, _ = run(folder, random_points=500)
    other, _ = run(folder, random_points=500, seed=1)
    assert np.array_equal(scene.points, again.points) and not np.array_equal(scene.points, other.points)
    seen = np.zeros(500, int)
    for camera in scene.cameras.values():
        at = scene.points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        uv = at[:, :2] / at[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        seen += (at[:, 2] > 0) & ((uv >= 0) & (uv <= (camera.width, camera.height))).all(axis=1)
    assert (seen >= 2).mean() > 0.95
    assert set(np.unique(scene.point_colors)) == set(range(40, 46))  # the six pictures' greys


def test_what_the_scene_brings_comes_into_the_normalised_frame(tmp_path):
    truth = some_truth(OPENCV, scale=5.0, offset=(50.0, 0.0, 0.0))
    folder = prepare(tmp_path / "s", "colmap", truth)
    means = torch.from_numpy(truth.points).float()
    gaussians = Gaussians(means, torch.ones(60, 4), torch.zeros(60, 3), torch.zeros(60), torch.zeros(60, 4, 3))
    io.save_ply(folder / "given.ply", gaussians)
    io.save_image(folder / "ref.png", np.full((2 * HEIGHT, 2 * WIDTH, 3), 77, np.uint8))
    io.save_image(folder / "ref2.png", np.arange(HEIGHT * WIDTH * 3).reshape(HEIGHT, WIDTH, 3).astype(np.uint8))
    given = yaml.safe_load(
        """
        gaussians: given.ply
        region: {center: [50, 0, 0], size: [1, 2, 3]}
        reference: [{view: v02, image: ref.png}, {view: v03, image: ref2.png, undistorted: true}]
        """
    )
    scene, out = run(folder, **given)
    similarity = scene.similarity
    np.testing.assert_allclose(io.load_ply(out / "gaussians.ply").means, similarity.apply(truth.points), atol=1e-5)
    region = io.load_json(out / "region.json")
    np.testing.assert_allclose(region["center"], similarity.apply(np.array([50.0, 0.0, 0.0])))
    np.testing.assert_allclose(region["size"], np.array([1.0, 2.0, 3.0]) * similarity.scale)
    references = io.load_given_references(out)
    assert references["v02"].shape == (HEIGHT, WIDTH, 3) and (references["v02"] == 77).all()
    assert np.array_equal(references["v03"], io.load_image(folder / "ref2.png"))


def test_preview_is_light_and_says_what_will_happen(tmp_path):
    spin_nerf(tmp_path / "s")
    notes = poses.preview(poses.Params(), tmp_path / "s")
    assert notes[0] == "4 training and 2 test views, 4 masks"
    assert notes[1] == f"SfM left out: {Path('sparse/0/images.bin')} brings poses"
    assert notes[2].startswith("undistortion: SIMPLE_RADIAL k1=0.05 moves the border by up to ")
    prepare(tmp_path / "t", "transforms", some_truth())
    assert "undistortion left out: the lens is a pinhole" in poses.preview(poses.Params(), tmp_path / "t")
    write_pictures(tmp_path / "p", ["a", "b", "c"])
    write_masks(tmp_path / "p" / "masks", ["a", "b", "c"])
    assert "SfM: 3 photos bring no poses" in poses.preview(poses.Params(), tmp_path / "p")
    code = (
        "import sys, pathlib, stages.poses as p; assert 'numpy' not in sys.modules; "
        "p.preview(p.Params(), pathlib.Path(sys.argv[1])); sys.exit('torch' in sys.modules or 'cv2' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path / "s")]).returncode == 0


# ------------------------------------------------------------------------------------------------- refusals


def edit_transforms(change):
    def edit(folder: Path) -> None:
        record = json.loads((folder / "transforms.json").read_text())
        change(record)
        (folder / "transforms.json").write_text(json.dumps(record))

    return edit


def nan_pose(record):
    record["frames"][2]["transform_matrix"][0][3] = float("nan")


def mirrored_pose(record):
    record["frames"][2]["transform_matrix"][0][:3] = [-v for v in record["frames"][2]["transform_matrix"][0][:3]]


def same_stem(folder: Path) -> None:
    write_pictures(folder / "other", ["v00"])
    edit_transforms(lambda r: r["frames"][0].update(file_path="other/v00.png"))(folder)


def drop_views(folder: Path) -> None:
    for k in range(2, 6):
        (folder / "images" / f"v{k:02d}.png").unlink()
        (folder / "masks" / f"v{k:02d}.png").unlink()


def drop_masks(folder: Path) -> None:
    for path in (folder / "masks").iterdir():
        path.unlink()


def drop_poses(folder: Path) -> None:
    (folder / "transforms.json").unlink()
    write_pictures(folder / "images", ["v03"], (HEIGHT, HEIGHT))


REFUSALS = [
    ("mask for no picture", lambda f: write_masks(f / "masks", ["zz"]), {}, r"zz\.png.*no picture"),
    ("no mask at all", drop_masks, {}, "no mask at all.*masks: none"),
    ("named masks missing", None, {"masks": "nowhere"}, "nowhere.*correct `masks`"),
    ("empty masks", lambda f: write_masks(f / "masks", [f"v{k:02d}" for k in range(6)], value=0), {}, "are empty"),
    ("mask of other proportions", lambda f: write_masks(f / "masks", ["v01"], (HEIGHT, WIDTH)), {}, r"v01\.png.*72x96"),
    ("two training views", drop_views, {}, "2 training views.*at least 3"),
    ("all views are test views", None, {"test": "every 1"}, "0 training views.*at least 3"),
    ("mixed sizes, no intrinsics", drop_poses, {}, "2 sizes and no intrinsics"),
    ("unreadable picture", lambda f: (f / "images" / "v01.png").write_text("x"), {}, r"v01\.png.*readable image"),
    ("NaN pose", edit_transforms(nan_pose), {}, r"transforms\.json.*'v03' is not finite"),
    ("mirrored pose", edit_transforms(mirrored_pose), {}, "'v03' is no rotation"),
    ("two views of a name", same_stem, {}, "view name 'v00' is also"),
    ("no intrinsics", edit_transforms(lambda r: r.pop("fl_x")), {}, "neither fl_x nor camera_angle_x"),
    ("unknown camera model", edit_transforms(lambda r: r.update(camera_model="X")), {}, "camera_model X"),
    ("other proportions than the camera", edit_transforms(lambda r: r.update(w=50)), {}, "other proportions"),
    ("unknown test view", None, {"test": ["w01"]}, r"test: there is no view 'w01'.*v01"),
    ("unknown train view", None, {"train": ["v00", "v01", "q"]}, "train: there is no view 'q'"),
    ("unknown clean view", None, {"clean": ["q"]}, "clean: there is no view 'q'"),
    ("clean view that is a test view", None, {"clean": ["v00"], "test": ["v00"]}, "v00 is no training view"),
    ("both train and test", None, {"train": ["v00", "v01", "v02"], "test": ["v02"]}, "v02 in both"),
    ("split that is neither", None, {"test": "some"}, "'some' is neither"),
    ("unknown reference view", None, {"reference": {"view": "q", "image": "ref.png"}}, "reference: there is no view"),
    ("missing reference", None, {"reference": {"view": "v01", "image": "no.png"}}, r"no\.png: no such file"),
    ("reference of other proportions", None, {"reference": {"view": "v01", "image": "tall.png"}}, r"tall\.png: 72x96"),
    ("missing images folder", None, {"images": "nowhere"}, "nowhere: no such folder"),
    ("missing gaussians", None, {"gaussians": "no.ply"}, r"no\.ply: no such file"),
    ("layout that is not there", None, {"layout": "colmap"}, "no COLMAP model"),
]


@pytest.mark.parametrize(("change", "params", "message"), [r[1:] for r in REFUSALS], ids=[r[0] for r in REFUSALS])
def test_refusals_name_file_and_remedy(tmp_path, change, params, message):
    folder = prepare(tmp_path / "s", "transforms", some_truth())
    write_pictures(folder, ["ref"])
    write_pictures(folder, ["tall"], (HEIGHT, WIDTH))
    if change is not None:
        change(folder)
    with pytest.raises(ValueError, match=message):
        run(folder, **params)
    assert not list((tmp_path / "s_out").rglob("*.*"))  # nothing was done before


def test_llff_refusals(tmp_path):
    folder = prepare(tmp_path / "s", "llff", some_truth())
    rows = np.load(folder / "poses_bounds.npy")
    np.save(folder / "poses_bounds.npy", rows[:-1])
    with pytest.raises(ValueError, match=r"5 poses.*6 pictures"):
        run(folder)
    rows[2, 3] = np.nan
    np.save(folder / "poses_bounds.npy", rows)
    with pytest.raises(ValueError, match=r"poses_bounds\.npy: rows \[2\]"):
        run(folder)


def test_cut_off_model_is_named(tmp_path):
    folder = prepare(tmp_path / "s", "colmap", some_truth())
    for name in ("images.bin", "points3D.bin", "cameras.bin"):
        path = folder / "sparse" / "0" / name
        whole = path.read_bytes()
        path.write_bytes(whole[:-10])
        with pytest.raises(ValueError, match=rf"{name}.*cut off"):
            run(folder)
        path.write_bytes(whole)


def test_masks_none_is_a_scene_to_fit_only(tmp_path):
    folder = prepare(tmp_path / "s", "transforms", some_truth())
    scene, out = run(folder, masks="none", test="every 3")
    assert not (out / "masks").exists() and len(scene.test) == 2
    drop_masks(folder)
    run(folder, region={"center": (0, 0, 0), "size": (1, 1, 1)})


# ------------------------------------------------------------------------------------------------- real captures


def capture(name: str) -> Path:
    if not (CAPTURES / name).is_dir():
        pytest.skip(f"the capture {name} is not in ../shared/data")
    return CAPTURES / name


def real(tmp_path: Path, name: str, **params):
    (tmp_path / "out").mkdir()
    poses.run(poses.Params(**params), tmp_path / "out", scene=capture(name))
    return io.load_scene(tmp_path / "out"), tmp_path / "out"


def test_statue(tmp_path):
    found = io.load_capture(capture("statue"))
    assert (
        len(found.pictures) == 29 and found.brought_by.name == "poses_bounds.npy" and len(found.poses.points) == 15881
    )
    assert next(iter(found.poses.lenses.values())).model == "PINHOLE" and not found.warnings
    names = ["IMG_2707", "IMG_2716", "IMG_2736"]
    scene, out = real(tmp_path, "statue", train=names)
    masks = io.load_raw_masks(out, names)
    assert all(0.03 < mask.mean() < 0.3 and mask.shape == (378, 504) for mask in masks.values())
    # The statue's points, by the masks, agree from view to view: the poses and the points share a frame.
    inside = np.ones(len(scene.points), bool)
    shares = []
    for name in names:
        camera = scene.cameras[name]
        at = scene.points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        uv = (at[:, :2] / at[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)).astype(int)
        ok = (at[:, 2] > 0) & (uv >= 0).all(axis=1) & (uv < (504, 378)).all(axis=1)
        hit = np.zeros(len(ok), bool)
        hit[ok] = masks[name][uv[ok, 1], uv[ok, 0]]
        inside &= hit
        shares.append(hit.sum())
    assert inside.sum() > 0.4 * min(shares) > 100


def test_bear(tmp_path):
    with pytest.raises(ValueError, match="no mask at all"):
        io.load_roles(capture("bear"), io.load_capture(capture("bear")))
    names = ["frame_00001", "frame_00030", "frame_00060", "frame_00090"]
    scene, out = real(tmp_path, "bear", masks="none", train=names[:3], test=names[3:])
    assert len(scene.points) == 34174 and scene.test == ("frame_00090",)
    shares = []
    for name, image in io.load_views(out, names).items():
        camera = scene.cameras[name]
        at = scene.points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        uv = (at[:, :2] / at[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)).astype(int)
        ok = (at[:, 2] > 0) & (uv >= 0).all(axis=1) & (uv < (camera.width, camera.height)).all(axis=1)
        difference = image[uv[ok, 1], uv[ok, 0]].astype(float) - scene.point_colors[ok]
        chance = image[uv[ok, 1], uv[ok, 0]].astype(float) - np.roll(scene.point_colors[ok], 997, axis=0)
        shares.append(np.abs(difference).mean() / np.abs(chance).mean())
    assert max(shares) < 0.8  # points have the colours of the pixels they fall on, more than by chance


def test_fox(tmp_path):
    with pytest.warns(UserWarning, match=r"17 of the 67 frames.*images/0005\.jpg.*images/0113\.jpg"):
        scene, _ = real(tmp_path, "fox", masks="none", train=["0001", "0002", "0003"], longest=240)
    camera = scene.cameras["0001"]
    assert (camera.width, camera.height) == (135, 240) and len(scene.points) == 10_000
    notes = poses.preview(poses.Params(masks="none", test="every 8"), capture("fox"))
    assert "43 training and 7 test views, 0 masks" in notes and any("OPENCV k1=0.05784" in n for n in notes)
