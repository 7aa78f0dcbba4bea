"""References whose texture was redrawn, e.g. by an image model, are accepted if they show their view.

Other pictures are refused with a message that gives the measured shares.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scenes import wall_scene
from scenes.capture import real_capture
from scenes.images import natural_noise, paint_red, psnr, rectangle_mask
from scenes.references import reference_entry, run_reference_stage

from lab.studies import redrawn
from reffusion.capture.lens import to_directions, to_pixels, undistort_image, undistorted_pinhole
from reffusion.capture.lenses import load_lenses
from reffusion.capture.views import load_placed_views
from reffusion.io.arrays import load_json, save_json
from reffusion.io.images import save_image
from reffusion.params.reference import ReferenceSpec
from reffusion.references import changes, color, registration
from reffusion.references.files import load_reference_files
from reffusion.shadows.reference_shadows import detect_shadow

pytestmark = pytest.mark.integration

SIZE = (480, 360)


def hole_mask(shape) -> np.ndarray:
    return rectangle_mask(shape[:2], (120, 220), (150, 290))


def paint_object(image: np.ndarray) -> np.ndarray:
    return paint_red(image, hole_mask(image.shape))


def shift_bands(image: np.ndarray, parallax: float) -> np.ndarray:
    """Imitate a picture from a neighboring position: bands move by 4 px, every second band by `parallax` px more."""
    rows, columns = (grid.astype(np.float32) for grid in np.mgrid[: image.shape[0], : image.shape[1]])
    displaced = 4 + parallax * ((columns // 80).astype(int) % 2)
    return cv2.remap(
        image, columns - displaced.astype(np.float32), rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )


@pytest.mark.parametrize("variant", redrawn.VARIANTS)
def test_a_redrawn_picture_of_the_view_is_accepted(variant):
    truth = natural_noise(0, SIZE)
    photo, hole = paint_object(truth), hole_mask(truth.shape)
    picture = redrawn.fit_size(redrawn.VARIANTS[variant](redrawn.redraw(truth)), photo)
    found = registration.register(picture, photo, hole)
    assert found.fits and found.inlier_ratio > 0.9 and not found.is_identical
    moved = registration.IDENTITY if found.affine is None else found.affine
    expected = {"shifted by 4 px": (3.3, -2.2), "8, shifted, gain, sharpened": (-2.5, 3.1)}.get(variant, (0, 0))
    np.testing.assert_allclose(moved[:, 2] + moved[:, :2] @ (240, 180) - (240, 180), expected, atol=0.2)
    image = color.recolor(registration.warp(picture, moved)[0], found.gain, found.offset)
    low = lambda picture: cv2.GaussianBlur(picture, (0, 0), 3)
    assert psnr(low(image), low(truth), hole) > 35, "the colours and the place of what fills the hole"
    assert (detect_shadow(image, photo, hole) & ~hole).mean() < 0.03, "redrawn texture is no shadow"
    away = cv2.dilate(hole.astype(np.uint8), np.ones((17, 17))) == 0
    usual = changes.redrawn_difference(image, photo, away)
    assert changes.changed_pixels(image, photo, away, usual).mean() < 0.02, "and nothing that was drawn"


@pytest.mark.parametrize("parallax", [2.0, 5.0])
def test_another_view_of_the_scene_is_refused(parallax):
    truth = natural_noise(0, SIZE)
    photo, hole = paint_object(truth), hole_mask(truth.shape)
    for picture in (shift_bands(truth, parallax), redrawn.redraw(shift_bands(truth, parallax))):
        found = registration.register(picture, photo, hole)
        assert not found.fits and found.inlier_ratio < 0.55
    same = registration.register(shift_bands(truth, 0.0), photo, hole)
    assert same.fits and same.max_shift == pytest.approx(4, abs=0.2), (
        "displaced by 4 px everywhere, it would be accepted"
    )


def test_another_scene_and_a_plain_picture_are_refused():
    photo, hole = paint_object(natural_noise(0, SIZE)), hole_mask(SIZE[::-1])
    for picture in (redrawn.redraw(natural_noise(1, SIZE)), np.zeros_like(photo), photo[::-1, ::-1].copy()):
        found = registration.register(picture, photo, hole)
        assert not found.fits and found.inlier_ratio < 0.1
    plain = np.full_like(photo, 120)
    assert not registration.register(photo, plain, hole).fits, "a plain photograph shows nothing of such a picture"


@pytest.mark.parametrize("size", [(8, 6), (64, 48), (480, 360)])
@pytest.mark.parametrize("kind", ["equal", "black", "plain", "hole over all", "hole over nearly all"])
def test_what_cannot_be_compared_is_accepted_and_says_so(size, kind):
    photo = natural_noise(0, size)
    hole = np.full(photo.shape[:2], kind == "hole over all")
    if kind == "hole over nearly all":
        hole[:, : -max(2, size[0] // 40)] = True
    pictures = {"black": np.zeros_like(photo), "plain": np.full_like(photo, 77)}
    picture = pictures.get(kind, photo)
    photo = picture.copy() if kind in ("black", "plain") else photo
    found = registration.register(picture, photo, hole)
    assert found.fits and found.affine is None and np.isfinite([*found.gain, *found.offset, found.max_shift]).all()
    assert "plain" in str(found) or kind == "equal"


def test_the_nearest_photograph_tells_views_of_a_plane_apart():
    """A picture of a wall from another view is recognised because it fits the photograph of that view better.

    Two views of a plane differ like a photograph and its crop, so a comparison with one photograph cannot decide.
    """
    views = {name: wall_scene.photo(wall_scene.CAMERAS[name]) for name in ("a2", "a3")}
    nothing = np.zeros(views["a2"].shape[:2], bool)
    picture = redrawn.redraw(views["a3"])
    found = registration.register(picture, views["a2"], nothing)
    assert registration.find_better_view(picture, found, [("a3", views["a3"], nothing)])[0] == "a3"
    own = registration.register(redrawn.redraw(views["a2"]), views["a2"], nothing)
    assert registration.find_better_view(redrawn.redraw(views["a2"]), own, [("a3", views["a3"], nothing)]) is None


# ------------------------------------------------------------------------------------------------------- the stage


def test_only_the_hole_of_a_redrawn_reference_is_taken(wall_folders, tmp_path):
    truth, mask = wall_scene.photo(wall_scene.CAMERAS["a2"]), wall_scene.true_mask(wall_scene.CAMERAS["a2"], 1.6)
    picture = redrawn.darken(redrawn.redraw(truth))
    noise = np.random.default_rng(0).normal(0, 6, truth.shape)
    save_image(wall_folders["scene"] / "ref.png", np.clip(picture + noise, 0, 255).astype(np.uint8))
    found = run_reference_stage(wall_folders, tmp_path / "out", **reference_entry("a2"))["a2"]
    away = cv2.dilate(mask.astype(np.uint8), np.ones((9, 9))) == 0
    assert np.array_equal(found.image[away], truth[away]), "the photograph elsewhere"
    low = lambda image: cv2.GaussianBlur(image, (0, 0), 3)
    assert psnr(low(found.image), low(truth), mask) > 33, "its colours are the photograph's"


def test_a_refusal_gives_numbers_the_better_view_and_the_way_out(wall_folders, tmp_path):
    save_image(wall_folders["scene"] / "ref.png", wall_scene.photo(wall_scene.CAMERAS["a3"]))
    with pytest.raises(ValueError, match=r"ref\.png: does not fit its view 'a2'.*view 'a3' better \(\d+%\)"):
        run_reference_stage(wall_folders, tmp_path / "near", **reference_entry("a2"))
    save_image(wall_folders["scene"] / "ref.png", natural_noise(5, (wall_scene.WIDTH, wall_scene.HEIGHT)))
    expected = (
        r"ref\.png: does not fit its view 'a2': as it lies, it shows \d+% of \d+ places around the hole where the "
        r"photograph has them \(at least \d+% must; .*\); is it of another view, or of another scene\? "
        r"If it is right, write `trust: true` beside it in scene\.yaml$"
    )
    with pytest.raises(ValueError, match=expected):
        run_reference_stage(wall_folders, tmp_path / "other", **reference_entry("a2"))


@pytest.mark.parametrize("painted", [False, True])
def test_a_picture_may_be_made_over_the_photograph_or_over_the_undistorted_one(wall_folders, tmp_path, painted):
    file = wall_folders["poses"] / "lenses.json"
    record = load_json(file)
    record["views"]["a2"]["radial"] = [-0.25]
    save_json(file, record)
    lens, truth = load_lenses(wall_folders["poses"])[0]["a2"], wall_scene.photo(wall_scene.CAMERAS["a2"])
    pixels = np.stack(np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5), -1)
    photograph = undistort_image(truth, to_pixels(to_directions(pixels, lens), undistorted_pinhole(lens)))
    path = wall_folders["scene"] / ("painted/a2.png" if painted else "ref.png")
    entry = {} if painted else reference_entry("a2")
    hole = wall_scene.true_unobserved(wall_scene.CAMERAS["a2"], 1.6)
    for name, picture in (("straight", truth), ("photograph", photograph)):
        save_image(path, picture)
        found = run_reference_stage(wall_folders, tmp_path / name, **entry)["a2"]
        assert psnr(found.image, truth, hole) > 30, name


def test_a_person_overrules_a_refusal(wall_folders, tmp_path):
    other, mask = (
        natural_noise(5, (wall_scene.WIDTH, wall_scene.HEIGHT)),
        wall_scene.true_unobserved(wall_scene.CAMERAS["a2"], 1.6),
    )
    save_image(wall_folders["scene"] / "ref.png", other)
    with pytest.warns(
        UserWarning, match=r"shows \d+% of \d+ places.*taken all the same: scene\.yaml says `trust: true`"
    ):
        found = run_reference_stage(wall_folders, tmp_path / "out", **reference_entry("a2", trust=True))["a2"]
    assert mask.any() and np.array_equal(found.image[mask], other[mask]), "neither moved nor recolored"
    truth = wall_scene.photo(wall_scene.CAMERAS["a2"])
    away = cv2.dilate(wall_scene.true_mask(wall_scene.CAMERAS["a2"], 1.6).astype(np.uint8), np.ones((9, 9))) == 0
    assert np.array_equal(found.image[away], truth[away])


def test_a_painting_is_trusted_by_a_line_that_names_it(wall_folders, tmp_path):
    save_image(wall_folders["scene"] / "painted" / "a2.png", natural_noise(5, (wall_scene.WIDTH, wall_scene.HEIGHT)))
    line = r"write `reference: \{view: a2, image: painted/a2\.png, trust: true\}` in scene\.yaml"
    with pytest.raises(ValueError, match=line):
        run_reference_stage(wall_folders, tmp_path / "refused")
    views = load_placed_views(wall_folders["poses"])
    of_painting = ReferenceSpec(view="a2", image="painted/a2.png", trust=True)
    assert [each.trust for each in load_reference_files(wall_folders["scene"], views, of_painting)] == [True]
    save_image(wall_folders["scene"] / "ref.png", wall_scene.photo(wall_scene.CAMERAS["a2"]))
    of_another = ReferenceSpec(view="a2", image="ref.png", trust=True)
    assert [each.trust for each in load_reference_files(wall_folders["scene"], views, of_another)] == [False]


# --------------------------------------------------------------------------------------------------- real captures


@pytest.mark.parametrize("name", ["bear", "dinosaur", "fox", "garden", "statue"])
def test_real_photographs(name):
    """For every 40th view, its redrawn photograph is accepted.

    The photographs of the two nearest views and a photograph of another scene are refused.
    """
    capture, foreign = (
        redrawn.load_photographs(real_capture(each)) for each in (name, "bear" if name != "bear" else "garden")
    )
    photo_of_another = foreign.picture(next(iter(foreign.files)))
    for view in list(capture.files)[5::40]:
        photo, nearest = capture.picture(view), capture.nearest(view)[:2]
        hole = redrawn.make_hole(photo.shape, 1)
        for variant in ("redrawn", "64, cast, JPEG 60", "8, shifted, gain, sharpened"):
            found = registration.register(
                redrawn.fit_size(redrawn.VARIANTS[variant](redrawn.redraw(photo)), photo), photo, hole
            )
            assert found.inlier_ratio > 0.8, (view, variant)
        for picture in (*(capture.picture(other) for other in nearest), photo_of_another):
            assert not registration.register(redrawn.fit_size(picture, photo), photo, hole).fits, view
