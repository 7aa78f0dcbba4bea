"""Refinement of rough masks by a segmentation network.

The rough masks label Gaussians. The silhouette of the object's Gaussians in each view is the prompt for the network.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from reffusion import trace
from reffusion.clicks import propagation_without_network
from reffusion.clicks.fitted_views import FittedViews
from reffusion.clicks.propagation_with_network import combine, count_all_votes, draw_mask, project_votes
from reffusion.gaussians.neighbors import find_neighbors

ROUGH_RIM = 0.02  # share of the larger image side: pixels this near to a rough mask's border do not vote


def redraw_masks(views: FittedViews, masks: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the object's mask in every view, view -> bool [H, W], drawn anew from rough masks.

    The rough masks label Gaussians. In each view the silhouette of the object's Gaussians is the prompt for the
    network. The network's masks vote on the Gaussians in turn. Finally each view gets the network's mask or the
    projected votes, whichever agrees better with all votes.

    Args:
        views: the fitted scene; its views have a segmentation network.
        masks: view -> bool [H, W], the rough masks, at least one. Views may lack a mask.
    """
    gaussians, cameras, names = views.gaussians, views.cameras, list(views.cameras)
    image_of = lambda name: views.evidence_of(name).image
    near = find_neighbors(gaussians)
    labels = propagation_without_network.label_gaussians(gaussians, near, cameras, masks, image_of, ROUGH_RIM)
    drawn = {
        name: propagation_without_network.object_mask(gaussians, labels, cameras[name], image_of(name))
        for name in names
    }
    votes = count_all_votes(gaussians, cameras, drawn)
    for k in trace.progress(len(names), "masks drawn anew"):
        projection = project_votes(gaussians, cameras[names[k]], votes)
        if projection.silhouette.any():
            drawn[names[k]] = draw_mask(views.evidence_of(names[k]), projection)
    votes = count_all_votes(gaussians, cameras, drawn)
    return {
        name: combine(image_of(name), project_votes(gaussians, cameras[name], votes), drawn[name]) for name in names
    }
