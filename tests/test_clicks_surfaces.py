"""Where depth is known, a click selects the object in front of its surroundings, also on rough ground."""

from __future__ import annotations

import numpy as np
from scenes import wall_scene

from reffusion.clicks.corrections import apply_marks
from reffusion.clicks.marks import Mark
from reffusion.clicks.single_view import ViewEvidence


def checkered_disk_on_gravel():
    """Return picture, relief (log depth times focal length, px) and mask of a checkered disk before noisy gravel."""
    draw, (rows, columns) = np.random.default_rng(3), np.mgrid[:256, :256]
    disk = np.hypot(rows - 150, columns - 110) < 26
    picture = np.repeat(draw.integers(60, 180, (256, 256, 1)), 3, 2)
    cheques = (rows // 9 + columns // 9) % 2 > 0
    picture[disk & cheques], picture[disk & ~cheques] = (150, 110, 80), (90, 60, 40)
    relief = np.where(disk, 0.0, 60 + draw.normal(0, 8, (256, 256)).cumsum(1).clip(-40, 40))
    return picture.astype(np.uint8), relief, disk


def test_one_click_finds_a_chequered_thing_on_rough_ground():
    picture, relief, disk = checkered_disk_on_gravel()
    found = apply_marks(ViewEvidence(picture, relief), [Mark(np.array([[110.5, 150.5]]), True)])
    assert wall_scene.iou(found, disk) > 0.9


def test_a_further_click_never_loses_what_was_clicked_before():
    """Two clicks are on two parts. The mask holds both whole parts, not just the second and a pixel of the first."""
    picture, relief, disk = checkered_disk_on_gravel()
    rows, columns = np.mgrid[:256, :256]
    other = np.hypot(rows - 80, columns - 200) < 20
    picture[other], relief[other] = (200, 40, 40), 0
    found = apply_marks(
        ViewEvidence(picture, relief), [Mark(np.array([at]), True) for at in ((110.5, 150.5), (200.5, 80.5))]
    )
    assert wall_scene.iou(found & disk, disk) > 0.9 and wall_scene.iou(found & other, other) > 0.9
