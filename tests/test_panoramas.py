"""Panoramas are cut into the views that cameras would take at their centers, and placed as rigs."""

from itertools import pairwise

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from scenes.cameras import world_rays
from scenes.images import psnr
from scenes.room import speckle_texture

from reffusion.capture.cut_panoramas import DIRECTIONS, cut_view, perspective_camera, view_size
from reffusion.capture.load import load_capture
from reffusion.io.files import BadInput
from reffusion.io.images import save_image
from report import panoramas

HALF = np.array([2.0, 1.5, 2.5])  # half the sides of a room around the origin


def look_at_room(center: np.ndarray, rays: np.ndarray, textures: np.ndarray) -> np.ndarray:
    """Return the colors, uint8 [..., 3], that rays [..., 3] from a center in the room meet."""
    with np.errstate(divide="ignore"):
        times = (np.sign(rays) * HALF - center) / rays
    wall = times.argmin(-1)
    hit = center + rays * times.min(-1)[..., None]
    u = np.where(wall == 0, hit[..., 1], hit[..., 0])
    v = np.where(wall == 2, hit[..., 1], hit[..., 2])
    side = wall + 3 * (np.take_along_axis(rays, wall[..., None], -1)[..., 0] > 0)
    texels = lambda along: ((along + 3) * 40).astype(int) % textures.shape[1]
    return textures[side, texels(v), texels(u)].astype(np.uint8)


def make_panorama(center: np.ndarray, textures: np.ndarray, width: int, samples: int = 3) -> np.ndarray:
    """Return the panorama, uint8 [width / 2, width, 3], at a center; each pixel is the mean of samples^2 rays."""
    fine, height = width * samples, width // 2
    around, down = np.meshgrid(
        ((np.arange(fine) + 0.5) / fine - 0.5) * 2 * np.pi,
        ((np.arange(height * samples) + 0.5) / height / samples - 0.5) * np.pi,
    )
    rays = np.stack([np.sin(around) * np.cos(down), np.sin(down), np.cos(around) * np.cos(down)], -1)
    colors = look_at_room(center, rays, textures).astype(float)
    return colors.reshape(height, samples, width, samples, 3).mean((1, 3)).round().astype(np.uint8)


@pytest.fixture(scope="module")
def textures() -> np.ndarray:
    generator = np.random.default_rng(0)
    return np.stack([speckle_texture(generator) for _ in range(6)])


def test_cut_views_are_those_of_cameras_at_the_center(textures):
    center, smooth = np.array([0.3, -0.2, 0.1]), np.repeat(np.repeat(textures[:, ::16, ::16], 16, 1), 16, 2)
    panorama = make_panorama(center, smooth, 512, 2)
    size = view_size(512)
    for direction in (DIRECTIONS[0], DIRECTIONS[3], (200.0, -50.0)):
        camera = perspective_camera(direction, size)
        fine = perspective_camera(direction, 3 * size)
        true = look_at_room(center, world_rays(fine), smooth).astype(float).reshape(size, 3, size, 3, 3).mean((1, 3))
        found = cut_view(panorama, camera)
        shifted = cut_view(np.roll(panorama, 3, axis=1), camera)
        everywhere = np.ones((size, size), bool)
        assert psnr(found / 255, true / 255, everywhere) > 27, direction
        assert psnr(found / 255, true / 255, everywhere) > psnr(shifted / 255, true / 255, everywhere) + 4, direction


@pytest.mark.slow
def test_cut_panoramas_are_a_capture_with_true_poses(textures, tmp_path):
    generator = np.random.default_rng(1)
    declared = PngInfo()
    declared.add_itxt("XML:com.adobe.xmp", 'GPano:ProjectionType="equirectangular"')
    centers = {f"p{k}": np.array([0.35 * k - 0.7, *generator.uniform(-0.25, 0.25, 2)]) for k in range(5)}
    for name, center in centers.items():
        (tmp_path / "pano/images").mkdir(parents=True, exist_ok=True)
        panorama = Image.fromarray(make_panorama(center, textures, 768, 2))
        panorama.save(tmp_path / f"pano/images/{name}.png", pnginfo=declared)
    with pytest.raises(BadInput, match=r"5 of 5 pictures are 360-degree panoramas .*`reffusion panoramas .*/pano`"):
        load_capture(tmp_path / "pano")
    assert "40 views of 5 panoramas" in panoramas.make(str(tmp_path / "pano"), None)
    capture = load_capture(tmp_path / "pano-views")
    assert capture.layout == "colmap" and len(capture.pictures) == 40 and len(capture.poses.points) > 100
    found = {name: pose for name, pose in capture.poses.world_to_camera.items()}
    by_center: dict[str, list[np.ndarray]] = {}
    for view, pose in found.items():
        by_center.setdefault(view.split("-")[-1], []).append(-pose[:3, :3].T @ pose[:3, 3])
    spread = max(float(np.ptp(each, axis=0).max()) for each in by_center.values())
    ours = np.stack([by_center[name][0] for name in centers])
    true = np.stack(list(centers.values()))
    distances = lambda points: np.linalg.norm(points[:, None] - points[None], axis=-1)
    scale = distances(true).sum() / distances(ours).sum()
    assert spread * scale < 1e-4
    assert np.abs(distances(ours) * scale - distances(true)).max() < 0.005 * distances(true).max()
    headings = [found[f"{round(d[0]):03d}-p0"][2, :3] for d in DIRECTIONS]
    assert [float(a @ b) for a, b in pairwise(headings)] == pytest.approx([0.5**0.5] * 7, abs=1e-5)
    with pytest.raises(ValueError, match="not empty"):
        panoramas.make(str(tmp_path / "pano"), None)


def test_a_full_folder_is_refused_before_a_video_is_read(tmp_path):
    (tmp_path / "clip.mp4").write_bytes(b"no video")
    (tmp_path / "views").mkdir()
    (tmp_path / "views/x.txt").write_text("x")
    with pytest.raises(ValueError, match="views: not empty"):
        panoramas.make(str(tmp_path / "clip.mp4"), tmp_path / "views")
    assert not (tmp_path / "views-frames").exists()


def test_other_pictures_are_no_panoramas(tmp_path):
    save_image(tmp_path / "c/images/a.png", np.zeros((60, 100, 3), np.uint8))
    with pytest.raises(ValueError, match=r"a\.png: 100x60 px; an equirectangular panorama is twice as wide as high"):
        panoramas.make(str(tmp_path / "c"), None)
    with pytest.raises(ValueError, match="nowhere: no such folder or video"):
        panoramas.make(str(tmp_path / "nowhere"), None)
