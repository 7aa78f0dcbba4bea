"""Ignored pixels (`ignore/`) are read per view or for all, refused if wrong, and influence nothing that is made."""

from pathlib import Path

import numpy as np
import pytest
from scenes import wall_scene
from scenes.capture import HEIGHT, PINHOLE, WIDTH, make_truth, write_capture
from scenes.capture_checks import assert_message, refusal_message, run_with_messages, write_mask
from scenes.images import rectangle_mask
from scenes.references import write_wall_stages

from reffusion.capture.sfm import reconstruct
from reffusion.io.images import load_image, load_mask, save_image, save_mask
from reffusion.params.fit import Params as FitParams
from reffusion.workspace import Workspace
from stages import fit, initialize, masks, reference
from stages.plan import poses as poses_plan

BONNET = rectangle_mask((HEIGHT, WIDTH), (HEIGHT - 9, HEIGHT), (0, WIDTH))
PERSON = rectangle_mask((HEIGHT, WIDTH), (10, 50), (60, 75))


def write_capture_to_ignore(folder: Path, model=PINHOLE) -> list[str]:
    """Write a capture whose folder `ignore` has one picture for all views, and one of a passer-by in v01."""
    truth = make_truth(model)
    write_capture(folder, "colmap", truth)
    write_mask(folder / "ignore/all.png", BONNET)
    write_mask(folder / "ignore/v01.png", PERSON)
    return sorted(truth.world_to_camera)


def test_one_picture_for_all_views_and_one_of_a_view(tmp_path):
    views = write_capture_to_ignore(tmp_path / "c")
    _, out, sentences = run_with_messages(tmp_path / "c")
    assert_message(sentences, str(len(views)), "ignored")
    for name in views:
        expected = BONNET | PERSON if name == "v01" else BONNET
        assert (load_mask(out / "ignored" / f"{name}.png") == expected).all(), name
    files = [path for path in (tmp_path / "c").rglob("*") if path.is_file()]
    read = poses_plan.scene_files(poses_plan.Params(), tmp_path / "c", files)
    assert {tmp_path / "c/ignore/all.png", tmp_path / "c/ignore/v01.png"} <= set(read)
    assert poses_plan.scene_facts(poses_plan.Params(), tmp_path / "c") != poses_plan.scene_facts(
        poses_plan.Params(ignore="none"), tmp_path / "c"
    )


def test_an_empty_folder_ignores_nothing(tmp_path):
    write_capture(tmp_path, "colmap", make_truth(PINHOLE))
    facts = poses_plan.scene_facts(poses_plan.Params(), tmp_path)
    (tmp_path / "ignore").mkdir()
    assert poses_plan.scene_facts(poses_plan.Params(), tmp_path) == facts
    (tmp_path / "ignore/notes.txt").write_text("")
    assert "ignore holds 1 .txt, not read as masks" in refusal_message(tmp_path)


def test_ignored_pixels_are_undistorted_like_the_photographs(tmp_path):
    write_capture_to_ignore(tmp_path / "c", ("SIMPLE_RADIAL", (90.0, 48.0, 36.0, -0.2)))
    for name in ("v01", "v02"):
        picture = np.full((HEIGHT, WIDTH, 3), 40, np.uint8)
        picture[BONNET | PERSON] = 255
        (path,) = (tmp_path / "c/images").glob(f"{name}.*")
        save_image(path, picture)
    _, out, _ = run_with_messages(tmp_path / "c")
    shown = load_image(out / "images/v01.png")[..., 0]
    assert ((shown > 147) ^ load_mask(out / "ignored/v01.png")).mean() < 0.02


def test_wrong_masks_of_ignored_pixels_are_refused(tmp_path):
    folder = tmp_path / "c"
    write_capture_to_ignore(folder)
    (folder / "empty").mkdir()
    assert "no masks there" in refusal_message(folder, ignore="empty")
    assert "no masks there" in refusal_message(folder, ignore="people")
    write_mask(folder / "ignore/nobody.png", PERSON)
    assert "nobody.png: a mask for no picture" in refusal_message(folder)
    (folder / "ignore/nobody.png").unlink()
    write_mask(folder / "ignore/v02.png", np.zeros((60, 60), bool))
    assert "v02.png: 60x60 px, but its view 'v02' has 96x72" in refusal_message(folder)
    write_mask(folder / "ignore/v02.png", ~BONNET)
    assert "v02.png: all of the view 'v02' is ignored; leave it out instead: `exclude: [v02]`" in refusal_message(
        folder
    )


def test_ignored_pixels_bring_no_features(tmp_path):
    """Photographs of a wall, over which a picture moves with the camera: ignored, it does not disturb the poses."""
    draw = np.random.default_rng(0)
    wall = np.kron(draw.integers(0, 255, (60, 110, 3)), np.ones((6, 6, 1))).astype(np.uint8)
    bonnet = np.kron(draw.integers(0, 255, (15, 40, 3)), np.ones((6, 6, 1))).astype(np.uint8)
    covered = np.zeros((240, 240), bool)
    covered[150:] = True
    files = {}
    for k in range(4):
        picture = wall[40:280, 60 * k : 60 * k + 240].copy()
        picture[150:] = bonnet[:90]
        files[f"v{k}"] = tmp_path / f"v{k}.png"
        save_image(files[f"v{k}"], picture)
    save_mask(tmp_path / "ignore.png", covered)
    import pycolmap

    seen = {}
    real = pycolmap.incremental_mapping

    def remember(database, *rest):
        with pycolmap.Database.open(database) as opened:
            for image in opened.read_all_images():
                seen[image.name] = opened.read_keypoints(image.image_id)[:, 1]
        return real(database, *rest)

    pycolmap.incremental_mapping = remember
    try:
        reconstruct(files, 240, tmp_path / "work", ignore={name: (tmp_path / "ignore.png",) for name in files})
    except ValueError:
        pass  # a flat wall may not be placed; its features are tested
    finally:
        pycolmap.incremental_mapping = real
    assert len(seen) == 4 and all(len(rows) and rows.max() < 150 for rows in seen.values())


def write_wall_with_passers_by(folder: Path, color: int) -> dict[str, Path]:
    """Write the wall's stages, with a figure of a color at another place in each of two views, which is ignored."""
    folders = write_wall_stages(folder)
    for name, columns in (("a0", (5, 25)), ("a2", (55, 80))):
        figure = rectangle_mask((HEIGHT, WIDTH), (8, 60), columns)
        path = folders["poses"] / "images" / f"{name}.png"
        save_image(path, np.where(figure[..., None], np.uint8(color), load_image(path)))
        save_mask(folders["poses"] / "ignored" / f"{name}.png", figure)
    return folders


@pytest.mark.integration
def test_ignored_pixels_influence_nothing(tmp_path):
    """The whole job gives the same bytes, whatever the ignored pixels show."""
    made = {}
    for color in (0, 255):
        home = tmp_path / str(color)
        folders = write_wall_with_passers_by(home, color)
        for stage in ("again", "masks", "reference", "initialize"):
            (home / stage).mkdir(exist_ok=True)
        fit.run(FitParams(iterations=40), home / "again", poses=folders["poses"])
        masks.run(
            masks.Params(), home / "masks", **{k: folders[k] for k in ("poses", "fit")}, raw_masks=home / "raw_masks"
        )
        reference.run(reference.Params(inpainter="exemplar"), home / "reference", **folders)
        initialize.run(
            initialize.Params(refit_steps=20),
            home / "initialize",
            **{k: folders[k] for k in ("poses", "fit", "masks")},
            reference=home / "reference",
        )
        made[color] = {
            path.relative_to(home).as_posix(): path.read_bytes()
            for stage in ("again", "masks", "reference", "initialize")
            for path in (home / stage).rglob("*")
            if path.suffix in (".ply", ".png", ".npy")
        }
    assert made[0].keys() == made[255].keys()
    assert [name for name in made[0] if made[0][name] != made[255][name]] == []
    space = Workspace(tmp_path / "0/poses", tmp_path / "0/fit", tmp_path / "0/masks")
    figure = load_mask(tmp_path / "0/poses/ignored/a2.png")
    assert not (space.mask_sets["a2"].invent & figure & ~space.mask_sets["a2"].consistent).any()
    difference = np.abs(space.remove_object("a2").astype(int) - wall_scene.photo(wall_scene.CAMERAS["a2"]))
    assert np.median(difference[figure]) < 12
