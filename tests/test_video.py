"""Videos as scenes: the choice of frames, their cache, and refused videos; also HEIC photographs."""

import base64
import csv
import json
import struct
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from reffusion import command
from reffusion.capture import sfm, video_frames
from reffusion.io.files import BadInput
from reffusion.io.images import image_size, load_image
from report import cli
from runner import Refused
from runner.fleet.maintenance import clean
from runner.frames import update_frames
from runner.resolve import Request, resolve

ROOT = Path(__file__).resolve().parent.parent
WIDTH, HEIGHT, STEP, SHOTS = 160, 120, 3, 60
# 48 x 64 px in portrait format: red above, green and blue below. The file stores the picture rotated by 90 degrees.
PHONE = """
AAAAHGZ0eXBoZWljAAAAAG1pZjFoZWljbWlhZgAAAchtZXRhAAAAAAAAACFoZGxyAAAAAAAAAABwaWN0AAAAAAAAAAAAAAAAAAAAADRpbG9jAA
AAAERAAAIAAQAAAAAB7AABAAAAAAAAAOEAAgAAAAACzQABAAAAAAAAACQAAAA4aWluZgAAAAAAAgAAABVpbmZlAgAAAAABAABodmMxAAAAABVp
bmZlAgAAAQACAABFeGlmAAAAAA5waXRtAAAAAAABAAABB2lwcnAAAADmaXBjbwAAAHZodmNDAQNwAAAAkAAAAAAAHvAA/P34+AAADwNgAAEAGE
ABDAH//wNwAAADAJAAAAMAAAMAHroCQGEAAQAqQgEBA3AAAAMAkAAAAwAAAwAeoCCBBZbq5Ka5uAhoMCAAAAMDIAAAAwAhYgABAAZEAcFzwIkA
AAATY29scm5jbHgAAQANAAaAAAAAFGlzcGUAAAAAAAAAQAAAAEAAAAAoY2xhcAAAAEAAAAABAAAAMAAAAAEAAAAAAAAAAv////AAAAACAAAAEH
BpeGkAAAAAAwgICAAAAAlpcm90AwAAABlpcG1hAAAAAAAAAAEAAQaBAgMFhIYAAAAaaXJlZgAAAAAAAAAOY2RzYwACAAEAAQAAAQ1tZGF0AAAA
3SgBrwT4QTGZv/R7///yi52X5ElFtxtLTsccfeIuP/pJf/6BvfUGWvn62TYPY+ztDRl6fo8D1/i7Yyzz/0S4ospH7z8RC0YFKgubnEWslKlxc4
ZDa9qAZslLU3p03hx4ZFXT34o/RvYnVx7prs/wHjtHx9q2svac8LOtGetsdR+RdXiA2B7BaOkELaRCmNQ2V+tCPYPRtZ7gAsFOOYdbLkAAoH8t
HRVkn+Ih9gVQHJcNwZE99mmTLA4wX682x3LhnYOnfusGgcjm3v6KTlck0t/oky8NwwHmjWqtAjxcAAAABkV4aWYAAE1NACoAAAAIAAEBEgADAA
AAAQAGAAAAAAAA
"""


def render_walk(step=STEP):
    """Return the pictures of a camera that moves past a wall of blocks, by `step` px a picture."""
    draw = np.random.default_rng(1)
    wall = cv2.resize(draw.integers(0, 255, (40, 120, 3), np.uint8), None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST)
    return [wall[:HEIGHT, k * step : k * step + WIDTH] for k in range(SHOTS)]


def write_video(path, pictures):
    path.parent.mkdir(parents=True, exist_ok=True)
    written = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 30, (WIDTH, HEIGHT))
    for picture in pictures:
        written.write(np.ascontiguousarray(picture))
    written.release()
    return path


def blur_some(pictures):
    """Return four pictures for each picture: blurred, unchanged twice, and with motion blur."""
    soft = lambda picture: cv2.GaussianBlur(picture, (0, 0), 4)
    return [way(picture) for picture in pictures for way in (soft, np.copy, np.copy, lambda p: cv2.blur(p, (25, 1)))]


@pytest.fixture
def walk_video(tmp_path):
    return write_video(tmp_path / "given" / "walk.mp4", blur_some(render_walk()))


def test_sharp_frames_spaced_by_what_moves_and_the_same_ones_again(walk_video, tmp_path):
    message = video_frames.extract_frames(walk_video, tmp_path / "a", "hash")
    numbers = [int(path.stem.removeprefix("frame_")) for path in sorted((tmp_path / "a/images").iterdir())]
    assert all(number % 4 in (1, 2) for number in numbers), "none is blurred or smeared"
    way = STEP * SHOTS / WIDTH  # path of the camera in picture widths
    assert len(numbers) == pytest.approx(way / video_frames.SPACING, rel=0.3)
    apart = np.diff([number // 4 for number in numbers]) * STEP / WIDTH
    assert apart.min() > 0 and apart.max() <= 2.5 * video_frames.SPACING
    facts = json.loads((tmp_path / "a/frames.json").read_text())
    assert facts["taken"] == len(numbers) and facts["said"] == message and facts["size"] == [WIDTH, HEIGHT]
    with open(tmp_path / "a/frames.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4 * SHOTS and [int(r["frame"]) for r in rows if r["what"] == video_frames.TAKEN] == numbers
    video_frames.extract_frames(walk_video, tmp_path / "b", "hash")
    for path in (tmp_path / "a/images").iterdir():
        assert path.read_bytes() == (tmp_path / "b/images" / path.name).read_bytes()


def test_where_the_camera_stands_nothing_is_taken_twice(tmp_path):
    still = render_walk()
    stands = write_video(tmp_path / "stands.mp4", [*still[:30], *[still[30]] * 90, *still[30:]])
    video_frames.extract_frames(stands, tmp_path / "out", "")
    numbers = [int(path.stem.removeprefix("frame_")) for path in (tmp_path / "out/images").iterdir()]
    assert sum(30 <= number < 120 for number in numbers) <= 2


def test_a_film_that_was_held_upright_stands_upright(walk_video, tmp_path):
    data = bytearray(walk_video.read_bytes())
    at = data.find(b"tkhd") + 4 + 40  # the matrix of its track
    data[at : at + 36] = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, HEIGHT << 16, 0, 1 << 30)
    turned = walk_video.with_name("turned.mp4")
    turned.write_bytes(data)
    read = lambda path: next(frame for _, _, frame in video_frames._frames(path, lambda number: number == 9))
    assert np.array_equal(read(turned), np.rot90(read(walk_video), -1))


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (lambda path: path.write_text("no film"), "not a video that OpenCV reads; mp4, mov, mkv and webm are"),
        (lambda path: write_video(path, render_walk()[:5]), "5 frames; a video that walks around"),
        (lambda path: write_video(path, [render_walk()[0]] * 60), "moves by 0% of its width in all; walk around"),
        (lambda path: write_video(path, [np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * 60), "moves by 0% of its width"),
        (lambda path: write_video(path, [cv2.GaussianBlur(p, (0, 0), 9) for p in render_walk()]), "blurred throughout"),
        (lambda path: path.mkdir(), "a folder; a file is expected"),
    ],
)
def test_videos_without_enough_views_are_refused(tmp_path, made, message):
    made(tmp_path / "x.mp4")
    with pytest.raises(BadInput, match=message):
        video_frames.extract_frames(tmp_path / "x.mp4", tmp_path / "out", "")
    assert not (tmp_path / "out/images").exists() and not (tmp_path / "out/frames.json").exists()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a b.zip", "a b.zip: an archive; unpack it, and give the folder: scene=.*a b$"),
        ("x.tar.gz", "x.tar.gz: an archive; unpack it, and give the folder: scene=.*x$"),
        ("X.PLY", "X.PLY: a file of splats or points, and a scene has photographs; .*`reffusion patch before.ply"),
        ("x.splat", "x.splat: a file of splats or points"),
        ("IMG.jpg", "IMG.jpg: one picture; give the folder that holds the photographs: scene="),
    ],
)
def test_other_files_in_place_of_a_scene(tmp_path, name, message):
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(BadInput, match=message):
        video_frames.extract_frames(tmp_path / name, tmp_path / "out", "")


@pytest.mark.integration
def test_a_video_is_a_scene(walk_video, tmp_path, capfd):
    runs = tmp_path / "runs"
    frames = runs / "walk" / "frames"
    job = resolve(Request(ROOT, runs, str(walk_video), "laptop"))
    assert job.folder == frames and job.home == runs / "walk"
    again = lambda path=walk_video: update_frames(path, frames, ROOT, job.hashes)
    again()
    assert capfd.readouterr().out.count("frames of walk.mp4, the sharpest of every") == 1, "taken once"
    other = write_video(tmp_path / "other" / "walk.mp4", render_walk(2))
    with pytest.raises(Refused, match="holds frames of another video"):
        again(other)
    (frames / "masks").mkdir()
    (frames / "masks/frame_00002.png").write_bytes(b"by hand")
    again()
    walk_video.write_bytes(other.read_bytes())
    with pytest.raises(Refused, match=r"masks/frame_00002.png for them; rename the video"):
        again()
    (runs / "walk/source").write_text(str(frames))
    clean(Request(ROOT, runs, str(walk_video)))
    assert [path.name for path in (runs / "walk").rglob("*") if path.is_file()] == ["frame_00002.png"]
    with pytest.raises(Refused, match="not a video that OpenCV reads"):
        again(ROOT / "README.md")


def test_pages_find_the_results_of_a_video_by_its_name(walk_video, tmp_path, monkeypatch):
    monkeypatch.setattr(command, "workplace", lambda root: tmp_path)
    walk_video.parent.rename(tmp_path / "data")
    for name in ("walk.mp4", "walk", str(tmp_path / "data/walk.mp4")):
        arguments = cli.scene_parser("view", "Show.").parse_args(["--scene", name, "--runs", str(tmp_path / "runs")])
        assert cli.run_folder(arguments) == tmp_path / "runs/walk"


def test_photographs_of_a_phone(tmp_path):
    pytest.importorskip("pi_heif")
    path = tmp_path / "IMG_1.HEIC"
    path.write_bytes(base64.b64decode(PHONE))
    picture = load_image(path)
    assert picture.shape == (64, 48, 3) and image_size(path, upright=True) == (48, 64)
    assert np.abs(picture[[2, 2, -3, -3], [2, -3, 2, -3]].astype(int).argmax(-1) - (1, 0, 2, 0)).max() == 0
    assert sfm.relative_focal_length(path, tmp_path) is None
    path.write_bytes(base64.b64decode(PHONE)[:400])
    with pytest.raises(BadInput, match=r"IMG_1.HEIC: not a readable image"):
        load_image(path)


def test_heic_without_its_reader_is_refused_in_one_line(tmp_path):
    (tmp_path / "a.heic").write_bytes(base64.b64decode(PHONE))
    code = "import sys; sys.modules['pi_heif'] = None\nfrom reffusion.io.images import load_image; load_image('a.heic')"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert "a.heic: HEIC pictures need pi-heif: `pip install pi-heif`" in done.stderr.splitlines()[-1]
