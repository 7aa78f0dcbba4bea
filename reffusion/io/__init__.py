"""Every file format the project reads or writes, as `load_*` and `save_*` pairs.

Importing this package costs numpy and pillow only: torch comes in with the functions that return tensors.
"""

from .arrays import load_json, load_labels, save_json, save_labels, save_text
from .given import GivenReference, load_depth, load_given
from .images import image_size, load_exr, load_image, load_mask, save_exr, save_image, save_mask
from .layouts import LAYOUTS, Capture, Poses, load_capture
from .ply import load_ply, load_points, save_ply, save_points
from .roles import Roles, load_roles
from .scene import (
    load_mask_sets,
    load_raw_masks,
    load_references,
    load_scene,
    load_test_masks,
    load_views,
    save_mask_sets,
    save_references,
    save_scene,
)
from .traces import MAIN, QUANTITIES, load_trace, main_quantity, read_trace
from .undistorted import (
    check_masks,
    load_at,
    load_lenses,
    load_straight,
    load_straight_depth,
    save_lenses,
    save_undistorted,
)

__all__ = [
    "LAYOUTS",
    "MAIN",
    "QUANTITIES",
    "Capture",
    "GivenReference",
    "Poses",
    "Roles",
    "check_masks",
    "image_size",
    "load_at",
    "load_capture",
    "load_depth",
    "load_exr",
    "load_given",
    "load_image",
    "load_json",
    "load_labels",
    "load_lenses",
    "load_mask",
    "load_mask_sets",
    "load_ply",
    "load_points",
    "load_raw_masks",
    "load_references",
    "load_roles",
    "load_scene",
    "load_straight",
    "load_straight_depth",
    "load_test_masks",
    "load_trace",
    "load_views",
    "main_quantity",
    "read_trace",
    "save_exr",
    "save_image",
    "save_json",
    "save_labels",
    "save_lenses",
    "save_mask",
    "save_mask_sets",
    "save_ply",
    "save_points",
    "save_references",
    "save_scene",
    "save_text",
    "save_undistorted",
]
