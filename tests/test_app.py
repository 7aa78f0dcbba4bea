"""The page `reffusion app`: hostile requests, uploads, jobs of the page and of a terminal, and a walk in a browser."""

import http.client
import io
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest
from PIL import Image
from scenes import capture as captures
from scenes import wall_scene
from scenes.browser import open_page
from scenes.capture_checks import write_mask
from scenes.images import psnr, rectangle_mask
from scenes.processes import ROOT, wait_until
from scenes.references import run_reference_stage

from reffusion.capture.scene_folder import read_scene
from reffusion.io.arrays import load_json, save_json, save_text
from reffusion.io.images import load_image, load_mask, save_image
from reffusion.params.raw_masks import Params
from report import cli, verdict
from report.access import REFUSAL, Access
from report.app import brush, painting, pictures, scenes, uploads
from report.app.app import App
from report.app.job_progress import ShownProgress, estimate_remaining
from report.app.jobs import Jobs, Plan
from report.app.scenes import OpenScene
from report.app.server import Server
from report.job_data import load_job
from report.mask_session import find_ignore_files
from stages.plan import poses as poses_plan

pytestmark = pytest.mark.integration

LOWER_ROWS = rectangle_mask((captures.HEIGHT, captures.WIDTH), (60, captures.HEIGHT), (0, captures.WIDTH))
HOLD = """
import sys, time
from pathlib import Path
from runner.files import hold_lock
with hold_lock(Path(sys.argv[1]), "scene"):
    print("held", flush=True)
    time.sleep(600)
"""


class Page:
    """A server in a thread, and requests to it as any program could send them."""

    def __init__(self, runs):
        self.app = App(runs)
        self.server = Server(self.app, port=18190)
        self.thread = threading.Thread(target=self.server.serve, daemon=True)
        self.thread.start()
        wait_until(lambda: self.server.server.started)

    def send(self, method, path, body=None, **headers):
        """Return (status, body) of a request; a body that is no bytes is sent as JSON.

        Cookie="" sends it without the token.
        """
        headers = {"Cookie": f"reffusion_{self.server.port}={self.server.access.token}"} | headers
        connection = http.client.HTTPConnection("127.0.0.1", self.server.port, timeout=60)
        content = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
        connection.request(method, path, content, headers)
        answer = connection.getresponse()
        return answer.status, answer.read()

    def post(self, path, body=None):
        status, answer = self.send("POST", path, {} if body is None else body)
        return status, json.loads(answer)

    def state(self):
        return json.loads(self.send("GET", "/scenes/scene/state")[1])

    def close(self):
        self.server.stop()
        self.thread.join()


@contextmanager
def serve_page(home):
    with pytest.MonkeyPatch.context() as patch:
        for module in (uploads, scenes):
            patch.setattr(module, "workplace", lambda root: home)
        opened = Page(home / "runs")
        yield opened
        opened.close()


@pytest.fixture
def page(tmp_path):
    with serve_page(tmp_path) as opened:
        yield opened


@pytest.fixture(scope="module")
def still_page(tmp_path_factory):
    """A page that makes no plans, and on which `still_scene` is open."""
    with serve_page(tmp_path_factory.mktemp("still")) as opened:
        opened.app.jobs.renew_plan = lambda scene: opened.app.jobs.plans.setdefault(scene.name, Plan())
        open_scene(opened, opened.app.jobs.runs.parent / "scene")
        yield opened


@pytest.fixture
def still_scene(still_page):
    return still_page.app.jobs.runs.parent / "scene"


@pytest.fixture
def scene(page, tmp_path):
    return open_scene(page, tmp_path / "scene")


def open_scene(page, folder, model=captures.PINHOLE):
    """Write a capture with poses and without masks, and open it; return its folder."""
    truth = captures.make_truth(model)
    captures.write_pictures(folder / "images", sorted(truth.world_to_camera))
    captures.write_model(folder / "sparse/0", truth, ending=".png")
    assert page.post("/scenes", {"path": str(folder)}) == (200, {"name": "scene"})
    return folder


def png(width=40, height=30):
    file = io.BytesIO()
    Image.fromarray(np.zeros((height, width, 3), np.uint8)).save(file, "PNG")
    return file.getvalue()


# ------------------------------------------------------------------------------------------------ hostile requests


def test_other_pages_and_machines_are_refused(still_page):
    page, own = still_page, f"127.0.0.1:{still_page.server.port}"
    for path in ("/", "/app.js", "/scenes", "/scenes/scene/state", "/scenes/scene/events", "/scenes/scene/mask/"):
        assert page.send("GET", path, Host="elsewhere.example")[0] == 403
        assert page.send("GET", path, Origin="http://elsewhere.example")[0] == 403
    for path in (
        "/scenes",
        "/uploads",
        "/scenes/scene/do/start",
        "/scenes/scene/mask/save",
        "/scenes/scene/paint/v00",
        "/scenes/scene/paint/v00/fill",
    ):
        for origin in ("http://elsewhere.example", "null", f"http://{own}.elsewhere.example", "http://127.0.0.1:1"):
            assert page.send("POST", path, {}, Origin=origin)[0] == 403
    assert page.send("GET", "/scenes", Origin=f"http://{own}")[0] == 200


EVERY_ADDRESS = {
    "GET": (
        "/", "/app.css", "/app.js", "/scenes", "/scenes/scene/state", "/scenes/scene/events",
        "/scenes/scene/pictures/photo/v00", "/scenes/scene/paint/v00", "/scenes/scene/paint/v00/canvas",
        "/scenes/scene/export/scene.ply", "/scenes/scene/mask/", "/scenes/scene/mask/state",
        "/scenes/scene/mask/photo/v00", "/none",
    ),
    "POST": (
        "/scenes", "/uploads", "/uploads/x/a.png", "/scenes/scene/do/start", "/scenes/scene/live",
        "/scenes/scene/mask/mark", "/scenes/scene/mask/save", "/scenes/scene/paint/v00",
        "/scenes/scene/paint/v00/fill",
    ),
}  # fmt: skip


def test_every_address_asks_for_the_token(still_page):
    """It may come with the address, whose answer sets a cookie, or with the cookie; the brush and uploads too."""
    page, token, port = still_page, still_page.server.access.token, still_page.server.port
    wrong = ("", f"reffusion_{port}=", f"reffusion_{port}={token}x", f"other={token}", f"reffusion_{port}=é")
    for method, paths in EVERY_ADDRESS.items():
        for path in paths:
            for cookie in wrong:
                status, answer = page.send(method, path, {} if method == "POST" else None, Cookie=cookie)
                assert (status, json.loads(answer)) == (403, {"error": REFUSAL}), (method, path, cookie)
            assert page.send(method, f"{path}?token={token[:-1]}", Cookie="")[0] == 403
    assert page.send("GET", "/", Cookie="", Accept="text/html")[1] == REFUSAL.encode(), "one line for a person"
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    connection.request("GET", f"/?token={token}")
    cookie = connection.getresponse().headers["Set-Cookie"]
    assert cookie == f"reffusion_{port}={token}; Path=/; Max-Age=604800; HttpOnly; SameSite=Strict"
    assert page.send("GET", "/scenes", Cookie=f"a=b; {cookie.split(';')[0]}")[0] == 200
    assert page.send("POST", f"/uploads?token={token}", {"name": "x"}, Cookie="")[0] == 200
    assert page.send("GET", f"/scenes?token={token}", Cookie="", Host="elsewhere.example")[0] == 403


def test_two_servers_have_two_tokens_of_256_bits():
    one, other = Access(1), Access(1)
    assert one.token != other.token and len(one.token) == 43 and one.token not in repr(one)


@pytest.mark.parametrize("path", [
    "/../../etc/passwd", "/app.css/../server.py", "/%2e%2e/server.py", "/static/index.html",
    "/scenes/scene/pictures/photo/..%2f..%2fsecret", "/scenes/scene/pictures/photo/%2fetc%2fpasswd",
    "/scenes/scene/pictures/secret/v00", "/scenes/scene/export/..%2f..%2fsecret.png",
    "/scenes/scene/export/receipt.json",
    "/scenes/scene/paint/..%2f..%2fsecret", "/scenes/scene/paint/..%2f..%2fsecret/canvas",
    "/scenes/scene/paint/v00/canvas", "/scenes/..%2fscene/state", "/scenes/none/state", "/scenes/none/events",
    "/scenes/scene/mask/", "/scenes/scene/mask/photo/v00",
])  # fmt: skip
def test_no_address_leads_to_another_file(still_page, still_scene, path):
    save_image(still_scene.parent / "secret.png", np.zeros((4, 4, 3), np.uint8))
    assert still_page.send("GET", path)[0] == 404
    assert still_page.send("POST", path, {})[0] in (404, 405)


def test_wrong_requests_get_one_line(still_page, still_scene, tmp_path):
    page = still_page
    assert page.post("/scenes", {"path": str(tmp_path / "none")})[0] == 400
    assert "no photographs" in page.post("/scenes", {"path": str(tmp_path)})[1]["error"]
    assert page.post("/scenes", {})[0] == 404 and page.post("/scenes", [])[0] == 400
    assert page.send("POST", "/scenes", b"[")[0] == 400
    assert page.send("POST", "/scenes", b" " * 2_000_001)[0] == 413
    assert page.post("/scenes/scene/do/format-the-disk")[0] == 404
    other = tmp_path / "other/scene"
    shutil.copytree(still_scene, other)
    status, answer = page.post("/scenes", {"path": str(other)})
    assert status == 400 and str(still_scene) in answer["error"]


def test_uploads_are_decoded_and_stay_in_their_folder(page, tmp_path, monkeypatch):
    name = page.post("/uploads", {"name": "../../My photos!"})[1]["name"]
    assert name == "My_photos"
    send = lambda file, content: page.send("POST", f"/uploads/{name}/{quote(file, safe='')}", content)
    assert send("../../a b.png", png())[0] == 404, "a name with a slash is no address"
    for file in ("..\\a b.png", "a_b.png", "a_b.png"):  # another photograph replaces none, the same one does
        assert send(file, png())[0] == 200
    for file, content in (
        ("b.png", b"no picture"),
        ("c.sh", b"#!/bin/sh"),
        ("d", png()),
        ("e.png", png()[:60]),
        ("f.mp4", png()),
    ):
        status, answer = send(file, content)
        assert status == 400 and file in json.loads(answer)["error"]
    monkeypatch.setattr(uploads, "PICTURE_BYTES", 50)
    assert send("g.png", png())[0] == 413
    assert page.send("POST", "/uploads/other/h.png", png())[0] == 404
    files = sorted(p.relative_to(tmp_path).as_posix() for p in (tmp_path / "data").rglob("*") if p.is_file())
    assert files == ["data/My_photos/images/a_b-2.png", "data/My_photos/images/a_b.png"]
    assert page.post("/uploads", {"name": "My photos"})[1]["name"] == "My_photos-2"
    assert page.post("/uploads", {"name": "../"})[0] == 400


def test_a_painting_must_show_its_view_and_replaces_none_unasked(tmp_path):
    scene = OpenScene("scene", tmp_path / "scene", tmp_path / "runs/scene")
    scene.source.mkdir()
    save_image(scene.home / painting.TO_PAINT / "v00.png", np.zeros((30, 40, 3), np.uint8))
    for content in (b"", b"text", png()[:50], png(30, 40)):
        with pytest.raises(ValueError):
            painting.save_painting(scene, "v00", content, replace=False)
    assert not (scene.source / "painted").exists()
    painting.save_painting(scene, "v00", png(80, 60), replace=False)
    with pytest.raises(FileExistsError):
        painting.save_painting(scene, "v00", png(), replace=False)
    assert load_image(scene.source / "painted/v00.png").shape == (60, 80, 3)
    painting.save_painting(scene, "v00", png(), replace=True)
    assert load_image(scene.source / "painted/v00.png").shape == (30, 40, 3)


def turned_jpeg(width=40, height=30):
    """Return a JPEG as phones save an upright picture: pixels on their side, and a tag that says how to turn them."""
    picture, tag, file = Image.new("RGB", (height, width)), Image.Exif(), io.BytesIO()
    tag[0x0112] = 6
    picture.save(file, "JPEG", exif=tag)
    return file.getvalue()


def test_the_orientation_tag_of_paintings_and_photographs_is_obeyed(tmp_path):
    scene = OpenScene("scene", tmp_path / "scene", tmp_path / "runs/scene")
    save_image(scene.home / painting.TO_PAINT / "v00.png", np.zeros((30, 40, 3), np.uint8))
    for k in range(3):
        (tmp_path / "scene/images").mkdir(parents=True, exist_ok=True)
        (tmp_path / f"scene/images/v0{k}.jpg").write_bytes(turned_jpeg())
    painting.save_painting(scene, "v00", turned_jpeg(), replace=False)
    assert load_image(scene.source / "painted/v00.png").shape == (30, 40, 3)
    assert Image.open(io.BytesIO(pictures.draw_thumbnail(scene, "v00"))).size == (40, 30)


def transparent_png(image, hole):
    file = io.BytesIO()
    Image.fromarray(np.dstack([image, np.where(hole, 0, 255).astype(np.uint8)])).save(file, "PNG")
    return file.getvalue()


def test_a_marked_part_is_filled_with_patches_of_photographs(wall_folders, tmp_path):
    scene = OpenScene("scene", wall_folders["scene"], tmp_path)
    for stage in ("poses", "fit", "masks"):
        save_json(tmp_path / stage / "receipt.json", {})
    run_reference_stage(wall_folders, tmp_path / "reference")
    shutil.copytree(tmp_path / "reference/to_paint", tmp_path / painting.TO_PAINT)
    view = verdict.RANKED.findall((tmp_path / painting.TO_PAINT / "ranked.txt").read_text())[0][0]
    photo = wall_scene.photo(wall_scene.CAMERAS[view])
    hole = wall_scene.true_unobserved(wall_scene.CAMERAS[view], 1.6)
    save_image(tmp_path / f"evaluate/renders/{view}.png", np.full_like(photo, 255))
    before = np.array(Image.open(io.BytesIO(brush.draw_canvas(scene, view))))
    assert (before[hole] == 255).all() and not (before[~hole] == 255).all()
    fill = lambda seed: np.array(Image.open(io.BytesIO(brush.fill(scene, view, transparent_png(before, hole), seed))))
    filled = fill(0)
    assert np.array_equal(filled[~hole], before[~hole]) and np.array_equal(fill(0), filled)
    assert psnr(filled, photo, hole) > psnr(before, photo, hole) + 5
    for wrong in (before, before[1:]):
        with pytest.raises(ValueError, match=r"mark a part|the picture has"):
            brush.fill(scene, view, transparent_png(wrong, np.zeros(wrong.shape[:2], bool)), 0)
    with pytest.raises(ValueError, match="at most half of it"):
        brush.fill(scene, view, transparent_png(before, np.ones_like(hole)), 0)


# ------------------------------------------------------------------------------------------------ state, jobs


def test_the_state_says_what_was_found_and_what_is_missing(page, scene):
    connection = http.client.HTTPConnection("127.0.0.1", page.server.port, timeout=60)
    connection.request("GET", page.server.access.link("/scenes/scene/events"))
    answer = connection.getresponse()
    assert answer.headers["Content-Type"].startswith("text/event-stream")
    while True:  # a first state without a plan, then the plan
        line = answer.readline().decode()
        if line.startswith("data: ") and (state := json.loads(line[6:]))["plan"]["stages"]:
            break
    connection.close()
    assert state["pictures"] == [f"v{k:02d}" for k in range(6)] and "layout: COLMAP" in state["found"]
    assert state["lacks_masks"] and state["result"] is None and state["job"]["state"] == "idle"
    assert state["plan"]["due"][0] == "poses" and state["plan"]["seconds"] > 0
    status, picture = page.send("GET", "/scenes/scene/pictures/small/v00")
    assert status == 200 and Image.open(io.BytesIO(picture)).format == "JPEG"
    # A finer fit is chosen, and its time is in the plan.
    assert state["plan"]["quality"] == "laptop"
    assert page.post("/scenes/scene/do/quality", {"profile": "paper"})[0] == 400
    assert page.post("/scenes/scene/do/quality", {"profile": "fine"})[0] == 200
    wait_until(lambda: page.state()["plan"]["quality"] == "fine" and not page.state()["plan"]["busy"])
    assert page.state()["plan"]["seconds"] > state["plan"]["seconds"]


def test_a_job_is_started_stopped_and_goes_on(page, scene):
    assert page.post("/scenes/scene/do/stop")[0] == 400, "nothing runs"
    assert page.post("/scenes/scene/do/start")[0] == 200
    wait_until(lambda: page.state()["job"]["state"] == "failed")
    assert "no mask at all" in page.state()["job"]["words"]
    assert page.post("/scenes/scene/do/mask") == (200, {"open": False})
    wait_until(lambda: page.state()["job"]["stage"] == "fit")
    assert page.post("/scenes/scene/do/start")[0] == 400, "one at a time"
    assert page.post("/scenes/scene/do/stop")[0] == 200
    wait_until(lambda: page.state()["job"]["state"] == "stopped")
    assert page.state()["has_poses"]
    assert page.post("/scenes/scene/do/mask") == (200, {"open": True})
    assert page.send("GET", "/scenes/scene/mask/state")[0] == 200
    wait_until(lambda: page.state()["job"]["stage"] == "fit")
    assert page.post("/scenes/scene/do/stop")[0] == 200, "the mask page is open now"
    wait_until(lambda: page.state()["job"]["state"] == "stopped")
    assert page.state()["awaits_fit"] and page.state()["job"]["target"] == "fit"
    assert page.post("/scenes/scene/do/mask") == (200, {"open": True})
    wait_until(lambda: page.state()["job"]["stage"] == "fit")
    assert "poses: " not in "\n".join(page.state()["job"]["log"]), "the poses are not found anew"


@pytest.fixture
def ignoring(page, tmp_path, monkeypatch):
    """The page with a scene whose mask step is open, while no fit runs; v02 ignores its lower rows already."""
    scene = open_scene(page, tmp_path / "scene", captures.OPENCV)
    write_mask(scene / "ignore/v02.png", LOWER_ROWS)
    run_first_stages(page)
    monkeypatch.setattr(page.app.jobs, "start", lambda *_, **__: None)
    assert page.post("/scenes/scene/do/mask") == (200, {"open": True})
    return page


def run_first_stages(page):
    Jobs.start(page.app.jobs, page.app.scenes["scene"], "raw_masks", with_clicks=True)
    wait_until(lambda: page.state()["job"]["state"] == "finished" and not page.state()["plan"]["busy"])


def paint(page, view, sign="+", radius=5.0, ignores=True):
    stroke = {"view": view, "points": [[30, 20], [60, 20]], "sign": sign, "radius": radius, "ignores": ignores}
    return page.post("/scenes/scene/mask/mark", stroke)


def blue_pixels(page, view):
    status, picture = page.send("GET", f"/scenes/scene/mask/ignored/{view}")
    assert status == 200
    return np.array(Image.open(io.BytesIO(picture)))[..., 3] > 0


def ignored_views(page):
    state = json.loads(page.send("GET", "/scenes/scene/mask/state")[1])
    return [view["name"] for view in state["views"] if view["ignored"] is not None]


def test_strokes_of_the_second_color_are_ignored_in_their_photograph(ignoring, tmp_path):
    page, folder, placed = ignoring, tmp_path / "scene/ignore", tmp_path / "runs/scene/poses/ignored"
    assert ignored_views(page) == ["v02"] and "poses" not in page.state()["plan"]["due"]
    for view in ("v01", "v02"):
        assert paint(page, view)[0] == 200
    shown = {view: blue_pixels(page, view) for view in ("v01", "v02")}
    assert shown["v01"][20, 30:60].all() and 0 < shown["v01"].mean() < 0.1
    state = json.loads(page.send("GET", "/scenes/scene/mask/state")[1])
    assert not state["busy"] and not any(view["mask"] for view in state["views"]), "no mask follows"
    assert page.post("/scenes/scene/mask/save", {}) == (200, {"written": 0, "kept": 0, "ignored": 2})
    assert sorted(path.name for path in folder.iterdir()) == ["v01.png", "v02.png"]
    stroke, both = (load_mask(folder / f"{view}.png") for view in ("v01", "v02"))
    assert stroke.any() and (both == stroke | LOWER_ROWS).all(), "what is there already stays"
    wait_until(lambda: "poses" in page.state()["plan"]["due"])
    run_first_stages(page)
    assert sorted(path.name for path in placed.iterdir()) == ["v01.png", "v02.png"]
    for view in ("v01", "v02"):
        found = load_mask(placed / f"{view}.png")
        assert (found ^ shown[view]).mean() < 0.01 and (found ^ blue_pixels(page, view)).mean() == 0


def test_the_eraser_takes_ignored_pixels_back_when_the_page_is_opened_again(ignoring, tmp_path):
    page, scene = ignoring, tmp_path / "scene"
    status, answer = paint(page, "v01", radius=0.0)
    assert status == 400 and "below the brush only" in answer["error"]
    paint(page, "v01")
    paint(page, "v00", ignores=False)
    assert page.post("/scenes/scene/mask/save", {}) == (200, {"written": 1, "kept": 0, "ignored": 1})
    assert [mark["view"] for mark in load_json(scene / "clicks.json")["marks"]] == ["v00"]
    page.app.scenes["scene"].mask_step = None
    assert page.post("/scenes/scene/do/mask") == (200, {"open": True})
    assert ignored_views(page) == ["v01", "v02"] and blue_pixels(page, "v01")[20, 45]
    paint(page, "v01", "-", radius=4.0)
    assert blue_pixels(page, "v01").any() and not blue_pixels(page, "v01")[20, 30:60].any()
    assert page.post("/scenes/scene/mask/undo", {})[1]["changed"] == "v01" and blue_pixels(page, "v01")[20, 45]
    for view in ("v01", "v02", "v03"):
        paint(page, view, "-", radius=9.0)
    assert page.post("/scenes/scene/mask/save", {})[1]["ignored"] == 3
    assert not any(load_mask(scene / f"ignore/{view}.png").any() for view in ("v01", "v03"))
    assert (load_mask(scene / "ignore/v02.png") == LOWER_ROWS).all()
    assert poses_plan.preview(poses_plan.Params(clicks={}), scene), "the empty pictures are accepted"
    assert page.post("/scenes/scene/mask/undo", {})[1]["changed"] == "v00", "only the eraser takes back what is saved"


def test_ignored_pixels_are_written_where_the_scene_reads_them(tmp_path):
    truth = captures.make_truth()
    captures.write_capture(tmp_path, "colmap", truth)
    views = truth.world_to_camera
    find = lambda name: find_ignore_files(tmp_path, name, read_scene(Params(ignore=name, clicks={}), tmp_path)[1])
    assert find(None) == {view: tmp_path / f"ignore/{view}.png" for view in views} and find("none") == {}
    write_mask(tmp_path / "people/all.png", LOWER_ROWS)
    write_mask(tmp_path / "people/v02_mask.png", LOWER_ROWS)
    own = {"v02": tmp_path / "people/v02_mask.png"}
    assert find("people") == {view: tmp_path / f"people/{view}.png" for view in views} | own
    (tmp_path / "arrays").mkdir()
    np.save(tmp_path / "arrays/v02.npy", LOWER_ROWS)
    assert find("arrays") == {}, "beside pictures, arrays would not be read"


def test_a_run_in_a_terminal_is_shown_and_left_alone(still_page, still_scene):
    page, runs = still_page, still_page.app.jobs.runs
    command = [sys.executable, "-c", HOLD, str(runs)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    holder = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout.readline() == "held\n"
        save_text(runs / "scene/fit.log", time.strftime("%Y-%m-%d %H:%M:%S fit {}\n"))
        job = page.state()["job"]
        assert job["state"] == "elsewhere" and job["stage"] == "fit" and f"process {holder.pid}" in job["words"]
        for action in ("start", "stop"):
            status, answer = page.post(f"/scenes/scene/do/{action}")
            assert status == 400 and "a terminal run" in answer["error"]
        with pytest.raises(ValueError, match="a terminal run"):  # a page that has made no plan yet
            Jobs(runs).start(OpenScene("scene", still_scene, runs / "scene"), "all")
        assert holder.poll() is None
    finally:
        holder.kill()
        holder.wait()
    wait_until(lambda: page.state()["job"]["state"] == "idle")


def test_a_result_is_reached_though_its_photographs_were_moved_away(page, tmp_path, monkeypatch):
    """The plan was recorded before the stages `poses` and `evaluate` were done. Moved back, they are planned anew."""
    home, source = tmp_path / "runs/scene", tmp_path / "moved/scene"
    save_text(home / "source", str(source))
    entry = {"word": "run", "reason": "not run yet", "notes": [], "folder": None}
    save_json(home / "plan.json", {"stages": {stage: entry for stage in ("poses", "fit", "evaluate")}})
    for stage in ("poses", "evaluate"):
        save_json(home / stage / "receipt.json", {"params": {}, "seconds": 1.0, "needs": {}})
    save_image(home / "poses/images/v00.png", np.zeros((30, 40, 3), np.uint8))
    save_json(home / "poses/views.json", {"train": ["v00"], "test": []})
    recent = json.loads(page.send("GET", "/scenes")[1])["scenes"]
    assert recent == [{"name": "scene", "path": str(source), "state": "finished", "lost": True}]
    assert page.post("/scenes", {"path": str(source)}) == (200, {"name": "scene"})
    wait_until(lambda: not page.state()["plan"]["busy"])
    state = page.state()
    words = f"The photographs are no longer at {source}. Move them back to run stages again; finished results stay."
    assert state["lost"] == state["plan"]["error"] == words and state["result"]["views"] == ["v00"]
    done = {each["name"]: each["word"] for each in state["plan"]["stages"]}
    assert done == {"poses": "cached", "fit": "run", "evaluate": "cached"}
    assert page.send("GET", "/scenes/scene/pictures/photo/v00")[0] == 200
    assert page.post("/scenes", {"path": str(tmp_path / "moved/other")})[0] == 400
    monkeypatch.setattr(page.app.jobs, "_record_plan", lambda scene: "planned anew")
    source.mkdir(parents=True)
    assert not page.state()["lost"]
    wait_until(lambda: page.state()["plan"]["error"] == "planned anew")


@pytest.mark.parametrize(("level", "scene", "expected"), [
    ("1", "garden", "make scene=garden app"), ("1", None, "make app"),
    (None, "garden", "reffusion app --scene garden"), (None, None, "reffusion app"),
])  # fmt: skip
def test_the_page_names_the_command_that_was_typed(monkeypatch, level, scene, expected):
    if level is None:
        monkeypatch.delenv("MAKELEVEL", raising=False)
    else:
        monkeypatch.setenv("MAKELEVEL", level)
    assert cli.typed_command("app", scene and Path(scene)) == expected


# ------------------------------------------------------------------------------------------------ judgement


def write_job(home, remnants, origins, given=()):
    for stage, facts in (
        ("masks", {"remnants": remnants}),
        ("reference", {"given": list(given)}),
        ("initialize", {"origins": origins}),
        ("evaluate", {}),
    ):
        save_json(home / stage / "facts.json", facts)
        save_json(home / stage / "receipt.json", {"params": {"remnants": True}, "seconds": 1.0, "needs": {}})
    save_text(home / "reference/to_paint/ranked.txt", "# views\n1. IMG_1  40%  (painted)\n2. IMG 2  30%\n")


def test_the_judgement_says_what_is_left_and_what_would_help(tmp_path):
    shares = {"photographs": 0.8, "conflict": 0.0, "reference": 0.1, "patches": 0.06, "nothing": 0.04}
    write_job(tmp_path / "a", [], shares)
    said = verdict.describe_result(load_job(tmp_path / "a"))
    assert said == [
        "What the masks cover is removed, and no other part of the object was found.",
        "No photograph shows 20 % of what was behind it: that part is made up.",
        "To improve it most, paint the view IMG 2.",
    ]
    part = {"removed": False, "share": 0.01, "view": "IMG_7"}
    write_job(tmp_path / "b", [part, part | {"removed": True}], shares, given=["IMG_1"])
    said = verdict.describe_result(load_job(tmp_path / "b"))
    left = "The object is removed, but 1 part of it seems to be left. Look at the view IMG_7, and mark it there."
    assert said[:2] == [left, "No photograph shows 10 % of what was behind it: that part is made up."]
    write_job(tmp_path / "c", [], shares | {"reference": 0.0, "patches": 0.0, "nothing": 0.001})
    assert "The photographs show everything that was behind the object." in verdict.describe_result(
        load_job(tmp_path / "c")
    )


def test_the_judgement_waits_for_a_second_run(tmp_path):
    """The stage `masks` has run again; the pictures and other numbers are of the first run."""
    write_job(
        tmp_path / "a", [], {"photographs": 1.0, "conflict": 0.0, "reference": 0.0, "patches": 0.0, "nothing": 0.0}
    )
    receipt = {"params": {"remnants": True}, "seconds": 1.0, "needs": {"masks": "first"}}
    save_json(tmp_path / "a/evaluate/receipt.json", receipt)
    for output, is_judged in (("first", True), ("second", False)):
        save_json(tmp_path / "a/masks/receipt.json", receipt | {"needs": {}, "output": output})
        assert (len(verdict.describe_result(load_job(tmp_path / "a"))) == 2) == is_judged
    assert verdict.describe_result(load_job(tmp_path / "a")) == [
        "The pictures below are of the earlier result. The judgement follows when the new run is done."
    ]


# ------------------------------------------------------------------------------------------------ in a browser


def test_the_time_left_does_not_jump_with_the_first_steps_of_a_bar():
    """A stage of 100 s, whose bar after 5 % predicts an hour (it compiles), then the truth."""
    before, _ = estimate_remaining(19, 100, None)
    share, left = estimate_remaining(20, 100, (0.05, 3600))
    assert before / 3 < share <= before and 80 < left < 300
    assert estimate_remaining(90, 100, (0.9, 10)) == pytest.approx((0.9, 10), abs=0.01)
    assert estimate_remaining(60, 100, None) == (0.6, 40)
    assert 0.9 < estimate_remaining(200, 100, None)[0] < 1, "longer than expected: nearly done, but not stuck"
    assert estimate_remaining(20, None, (0.5, 20)) == (0.5, 20) and estimate_remaining(20, None, None) == (None, None)


def test_shown_progress_never_runs_back_and_its_end_stays():
    shown = ShownProgress(began=0)
    assert shown.update(40, "fit", 0.5, 60) == {"share": 0.5, "left": 60, "whole": 0.4}
    assert shown.update(50, "fit", 0.4, 62) == {"share": 0.5, "left": 50, "whole": pytest.approx(50 / 112)}
    slower = shown.update(60, "fit", 0.4, 300)
    assert slower == {"share": 0.5, "left": 300, "whole": pytest.approx(50 / 112)}, "a large error is corrected"
    assert shown.update(70, "masks", 0.0, None) == {"share": 0.0, "left": None, "whole": None}
    assert shown.update(80, "masks", None, 20) == {"share": None, "left": 20, "whole": 0.8}


@pytest.mark.slow
@pytest.mark.parametrize("width", [1280, 390])
def test_a_walk_from_photographs_to_an_export(page, mini_scene, tmp_path, width):
    shutil.copytree(mini_scene, tmp_path / "mini")
    save_text(tmp_path / "mini/scene.yaml", (mini_scene / "scene.yaml").read_text() + "\nbudget: 20s\n")
    with open_page(page.server.link(), width) as tab:
        tab.set_default_timeout(600_000)
        tab.fill("#path", str(tmp_path / "mini"))
        tab.click("#open button")
        tab.click("text=Next: start the job")
        tab.click("#run:enabled")
        tab.wait_for_function("state.job.state === 'running' && state.job.stage")
        tab.reload()  # the job goes on without the page
        tab.wait_for_function("state && state.result && !isBusy()")
        tab.evaluate("go('result')")
        tab.wait_for_function("document.getElementById('after').naturalWidth > 0")
        assert tab.locator("#verdict").text_content()
        first = tab.evaluate("shownView")
        tab.keyboard.press("ArrowRight")
        assert tab.evaluate("shownView") != first
        tab.evaluate("go('export')")
        tab.click("#make:visible")
        tab.wait_for_function("'before_after.webm' in state.export.files && !state.export.work")
        with tab.expect_download() as download:
            tab.click("#exports a >> nth=0")
        assert download.value.suggested_filename == "mini-scene.ply"
        assert tab.evaluate("document.documentElement.scrollWidth") <= width
