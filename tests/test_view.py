"""The viewer: cameras, layers of the result, and the pictures that a visitor receives."""

import http.client
import os
import shutil
import urllib.error
import urllib.request
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
import viser
from scenes import wall_scene
from scenes.browser import open_page
from scenes.cameras import make_scene
from scenes.gaussians import join_gaussians
from scenes.processes import wait_until

from reffusion.io.arrays import save_json, save_labels
from reffusion.io.images import save_image, save_mask
from reffusion.io.ply import save_ply
from reffusion.io.scene import load_scene, save_scene
from reffusion.splat import rasterizer
from reffusion.types import Similarity
from report import gaussian_layers, unseen_overlay, view
from report.access import REFUSAL, Access
from report.app import viewer_process

pytestmark = pytest.mark.integration

ACCESS = Access(8300)

SIMILARITY = Similarity(2.0, np.array([0.1, 0.2, 0.3]))
NEEDS = {"poses": "a", "fit": "b", "masks": "c", "initialize": "d", "distill": "e", "lift": None}


def write_finished_job(home, needs):
    """Write a run whose result is the wall; before distillation, the square is in front of the wall."""
    gaussians, labels = wall_scene.wall_and_square(1.0)
    train = {name: wall_scene.CAMERAS[name] for name in wall_scene.TRAIN}
    points = gaussians.means.double().numpy()
    scene = make_scene(train, points=points, similarity=SIMILARITY)
    poses = home.with_name(home.name.split("@")[0]) / "poses"
    save_scene(poses, scene)
    for name in wall_scene.TRAIN:
        save_image(poses / "images" / f"{name}.png", wall_scene.photo(train[name]))
    for stage in ("fit", "masks", "initialize", "distill"):
        if stage != "masks":
            save_ply(home / stage / "gaussians.ply", gaussians)
        if stage != "fit":
            save_labels(home / stage / "labels.npy", labels)
    result = gaussians if needs["distill"] else gaussians.map(lambda p: p[~labels])
    save_ply(home / "evaluate" / "scene.ply", result, similarity=SIMILARITY)
    save_json(home / "evaluate" / "receipt.json", {"needs": needs})
    return gaussians, labels


def visitor_camera(camera):
    """Return a visitor's camera as viser describes it."""
    rotation = camera.world_to_camera[:3, :3]
    place = {"wxyz": view._quaternion(rotation.T), "position": camera.center}
    return SimpleNamespace(**place, fov=view.vertical_fov(camera), aspect=camera.width / camera.height)


def test_a_visitor_who_stands_at_a_view_sees_that_view():
    gaussians, _ = wall_scene.wall_and_square(1.0)
    for camera in wall_scene.CAMERAS.values():
        centered = camera.cropped(0, 0, round(2 * camera.cx), round(2 * camera.cy))
        seen = view.visitor_camera(visitor_camera(centered), centered.height)
        assert (seen.width, seen.height) == (centered.width, centered.height)
        assert np.allclose(seen.world_to_camera, centered.world_to_camera)
        expected = (rasterizer.render(gaussians, centered).color.clamp(0, 1) * 255).round().byte().numpy()
        assert np.abs(view.render_picture(gaussians, seen).astype(int) - expected).max() <= 1


def test_the_layers_are_those_that_the_result_was_made_from(tmp_path):
    gaussians, labels = write_finished_job(tmp_path / "x", NEEDS)
    added, kept = int(labels.sum()), int((~labels).sum())
    save_ply(tmp_path / "x/distill/snapshots/20.ply", gaussians.map(lambda p: p[labels]))
    save_ply(tmp_path / "x/distill/snapshots/100.ply", gaussians.map(lambda p: p[labels][:3]))
    found = gaussian_layers.load_layers(tmp_path / "x", SIMILARITY)
    assert list(found.states) == ["initialization", "step 20", "step 100", "result"]
    count = lambda state, **parts: len(found.select(state, **{"kept": False, "added": False, "removed": False} | parts))
    for state, new in (("initialization", added), ("step 20", added), ("step 100", 3), ("result", added)):
        assert count(state, kept=True) == kept and count(state, added=True) == new
        assert count(state, removed=True) == added, "what the stage masks labelled of the fit"
        assert count(state, kept=True, added=True, removed=True) == kept + new + added and count(state) == 0
    assert torch.equal(found.states["result"][1].opacity_logits, gaussians.opacity_logits[labels])
    write_finished_job(tmp_path / "x@remove", NEEDS | {"initialize": None, "distill": None})
    alone = gaussian_layers.load_layers(tmp_path / "x@remove", SIMILARITY)
    assert list(alone.states) == ["result"] and len(alone.states["result"][1]) == 0 and len(alone.removed) == added
    with pytest.raises(ValueError, match="make scene=x variant=no_sds all"):
        gaussian_layers.load_layers(tmp_path / "x@no_sds", SIMILARITY)


def test_the_backdrop_of_evaluate_counts_as_kept(tmp_path):
    """Gaussians that the stage `evaluate` leaves out are missing from both layers."""
    gaussians, labels = write_finished_job(tmp_path / "x", NEEDS)
    backdrop = gaussians.map(lambda p: p[:5] + 3)
    fewer = join_gaussians(gaussians.map(lambda p: p[1:]), backdrop)
    save_ply(tmp_path / "x/evaluate/scene.ply", fewer, similarity=SIMILARITY)
    kept, added = gaussian_layers.load_layers(tmp_path / "x", SIMILARITY).states["result"]
    assert len(kept) + len(added) == len(fewer) and len(added) == int(labels[1:].sum())


def test_unobserved_pixels_are_hatched(tmp_path):
    gaussians, _ = write_finished_job(tmp_path / "x", NEEDS)
    scene = load_scene(tmp_path / "x/poses")
    shape = next(iter(scene.cameras.values()))
    for name in scene.train:  # the object covers the left of all training views
        save_mask(tmp_path / f"x/masks/consistent/{name}.png", np.indices((shape.height, shape.width))[1] < 12)
    seen_by = unseen_overlay.load_seen_views(tmp_path / "x", scene)
    camera = scene.cameras[scene.train[0]]
    picture = view.render_picture(gaussians, camera)
    noted = unseen_overlay.hatch_unseen(picture, gaussians, camera, seen_by)
    changed = (noted != picture).any(-1)
    assert changed[camera.height // 2 :, :8].mean() > 0.15 and not changed[camera.height // 2 :, -20:].any()
    assert unseen_overlay.load_seen_views(tmp_path / "y", scene) == []


def test_the_live_view_follows_a_job_from_stage_to_stage(tmp_path, monkeypatch):
    """A state replaces an earlier one as soon as the job has written it, also one without the object.

    A file that vanishes between two steps of a look does not end this.
    """
    home = tmp_path / "x"
    gaussians, labels = write_finished_job(home, NEEDS)
    for stage in ("initialize", "distill", "evaluate"):
        shutil.rmtree(home / stage)
    (home / "masks/labels.npy").rename(tmp_path / "labels.npy")
    opened = viewer_process.LatestViewer(home, 8350, Access(8350))
    try:
        wait_until(lambda: opened.gaussians is not None)
        assert len(opened.gaussians) == len(gaussians) and "with the object" in opened.title.content
        (tmp_path / "labels.npy").rename(home / "masks/labels.npy")
        os.utime(home / "masks/labels.npy")
        wait_until(lambda: "without the object" in opened.title.content)
        assert len(opened.gaussians) == int((~labels).sum())
        find, vanished = viewer_process.find_latest, iter([FileNotFoundError(), FileNotFoundError()])
        monkeypatch.setattr(viewer_process, "find_latest", lambda home: raise_next(vanished) or find(home))
        save_ply(home / "initialize/gaussians.ply", gaussians.map(lambda p: p[:5]))
        wait_until(lambda: "before distillation" in opened.title.content)
        assert len(opened.gaussians) == 5
    finally:
        opened.visitors.open = False
        opened.server.stop()


def raise_next(errors):
    """Raise the next of these errors; return None when there is none left."""
    if error := next(errors, None):
        raise error


def test_a_missing_scene_is_not_served(tmp_path):
    with pytest.raises(ValueError, match="make scene=y all"):
        view.Viewer(tmp_path / "y", 8300, Access(8300))


@pytest.fixture
def viewer(tmp_path):
    write_finished_job(tmp_path / "x", NEEDS)
    opened = view.Viewer(tmp_path / "x", 8300, ACCESS)
    yield opened
    opened.close()


def handshake(port, query="", **headers):
    """Return the status of the first line that answers a request to open a WebSocket."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    upgrade = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
    key = {"Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Protocol": "viser-v" + viser.__version__}
    connection.request("GET", f"/{query}", headers=upgrade | key | headers)
    return connection.getresponse().status


def test_the_page_and_its_websocket_ask_for_the_token(viewer):
    assert viewer.server.get_host() == "127.0.0.1"
    port = viewer.server.get_port()
    for query in ("", "?token=", "?token=wrong"):
        with pytest.raises(urllib.error.HTTPError, match="403") as refused:
            urllib.request.urlopen(f"http://127.0.0.1:{port}/{query}")
        assert refused.value.read().decode() == f"{REFUSAL}\n"
        assert handshake(port, query) == 403
    assert handshake(port, Cookie="reffusion_8300=wrong") == 403
    with urllib.request.urlopen(ACCESS.link(f"http://127.0.0.1:{port}/")) as page:
        assert page.status == 200 and page.headers["Set-Cookie"] == ACCESS.make_cookie()
    assert handshake(port, Cookie=f"other=1; reffusion_8300={ACCESS.token}") == 101


def test_a_visitor_gets_a_small_picture_at_once_then_the_whole_and_another_when_he_chooses(viewer, monkeypatch):
    images = []

    camera = visitor_camera(wall_scene.CAMERAS[wall_scene.TRAIN[0]])
    camera.on_update = lambda _: None
    guest = SimpleNamespace(
        client_id=7, camera=camera, scene=SimpleNamespace(set_background_image=lambda image, **_: images.append(image))
    )
    monkeypatch.setattr(viewer.server, "get_clients", lambda: {7: guest})
    viewer.visitors.serve(guest)
    wait_until(lambda: len(images) == 2)
    assert [image.shape[0] for image in images] == [view.MOVING, view.STILL]
    assert np.array_equal(images[-1], viewer._render_for(view.visitor_camera(camera, view.STILL), camera))
    checkbox = next(h for h in viewer.server.gui._gui_input_handle_from_uuid.values() if h.label == "what was kept")
    checkbox.value = False
    wait_until(lambda: len(images) == 4)
    assert images[-1].mean() < images[1].mean(), "the wall is gone"
    monkeypatch.setattr(viewer.server, "get_clients", dict)
    wait_until(lambda: 7 not in viewer.visitors.requests)


@pytest.mark.parametrize("width", [1280, 390])
def test_a_browser_shows_the_result_without_what_is_unchecked_and_before_distillation(viewer, width):
    """The square, which distillation added, is red and in the middle. The page sends no request to another machine."""
    with open_page(ACCESS.link(f"http://127.0.0.1:{viewer.server.get_port()}/"), width) as page:
        page.wait_for_selector("canvas", timeout=60000)

        def red() -> bool:
            data = np.frombuffer(page.screenshot(), np.uint8)
            blue, green, red = cv2.imdecode(data, cv2.IMREAD_COLOR)[380:420, width // 2 - 40 : width // 2 - 20].mean(
                (0, 1)
            )
            return red > 150 > 100 > max(blue, green)

        wait_until(red)
        added = page.get_by_role("checkbox").nth(1)
        added.uncheck()
        wait_until(lambda: not red())
        added.check()
        wait_until(red)
        page.get_by_role("slider").press("ArrowLeft")
        page.wait_for_function("document.body.innerText.match(/initialization/g).length > 1")
