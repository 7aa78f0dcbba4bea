"""Facts about an initialized scene: counts of Gaussians, uncovered pixels, and where pixels come from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from reffusion.initialize.filling import Filling
from reffusion.initialize.origins import ORIGINS, OriginMap
from reffusion.workspace import Workspace

LEAST_INVENTED_SHARE = 0.1  # share of the hole that no picture shows, above which a view is worth painting
WARN_SHARE = 0.01  # share of uncovered pixels of C above which a view is named in a message


def summarize(space: Workspace, filling: Filling, origins: Mapping[str, OriginMap]) -> dict[str, Any]:
    """Compute the contents of facts.json, and print what concerns the user.

    A pixel of C is uncovered if the initialization shows no surface there. The names of views with many such pixels are
    printed.

    Args:
        space: results of the stages `poses`, `fit` and `masks`.
        filling: the initialized scene.
        origins: view name -> origin of the pixels of C.
    """
    sets = space.mask_sets
    uncovered = {name: each.uncovered_share for name, each in origins.items()}
    shown = [each.shares for name, each in origins.items() if sets[name].consistent.any()]
    mean_shares = {key: sum(each[key] for each in shown) / max(len(shown), 1) for key in ORIGINS[1:]}
    patches: dict[str, np.ndarray] = {}
    for each in filling.extra:  # a view may have been completed more than once
        patches[each.camera.name] = patches.get(each.camera.name, False) | each.mask
    shares = {name: float(mask.sum() / sets[name].consistent.sum()) for name, mask in patches.items()}
    invented_shares = {name: each.shares["patches"] + each.shares["nothing"] for name, each in origins.items()}
    invented_pixels = lambda name: invented_shares[name] * np.count_nonzero(origins[name].classes)
    worst = max(origins, key=invented_pixels, default=None)
    print("what the object hid, mean over views: " + ", ".join(f"{mean_shares[key]:.0%} {key}" for key in mean_shares))
    if worst and filling.background is not None and invented_shares[worst] > LEAST_INVENTED_SHARE:
        share = invented_shares[worst]
        print(
            f"worth painting next: {worst}; no photograph or reference shows {share:.0%} of what the object hid there"
        )
    if named := [f"{name} ({share:.1%})" for name, share in uncovered.items() if share > WARN_SHARE]:
        print(
            f"uncovered in {len(named)} views: {', '.join(named)}: complete another view and add it to the references"
        )
    return {
        "new_gaussians": int(filling.draft.is_new.sum()),
        "removed_gaussians": int(space.labels.sum()),
        "floaters": filling.floaters,
        "completed": [each.camera.name for each in filling.trusted],
        "uncovered": uncovered,
        "extra_views": shares,
        "origins": mean_shares,
        "invented_shares": invented_shares,
        "uncovered_share": sum(uncovered.values()) / max(len(uncovered), 1),
    }
