"""A fitted scene with its views, and the transfer of marks from view to view by the surface."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from reffusion import geometry
from reffusion.clicks.color_evidence import sample_evenly
from reffusion.clicks.events import Event
from reffusion.clicks.marks import Mark
from reffusion.clicks.single_view import ViewEvidence
from reffusion.types import Camera, Gaussians

MAX_NETWORK_VIEWS = 64  # most views in which the network is asked; in other views the votes of these decide


@dataclass(frozen=True)
class FittedViews:
    """A fitted scene and its views.

    Attributes:
        gaussians: the fit, including the object.
        cameras: view -> Camera, for the views whose photographs show the object.
        evidence_of: function from a view's name to its photograph, relief and segmentation network.
    """

    gaussians: Gaussians
    cameras: Mapping[str, Camera]
    evidence_of: Callable[[str], ViewEvidence]

    @cached_property
    def network_views(self) -> frozenset[str]:
        """Up to `MAX_NETWORK_VIEWS` views, evenly spread by name, in which the network is asked for the object."""
        return frozenset(sample_evenly(sorted(self.cameras), MAX_NETWORK_VIEWS))

    def depth(self, name: str) -> np.ndarray:
        """Return the depth of the surface that a view shows, [H, W] camera z; the view must have a relief."""
        relief = self.evidence_of(name).relief
        assert relief is not None
        return np.exp(relief / self.cameras[name].fx)

    def surface(self, name: str) -> np.ndarray:
        """Return the surface points that a view shows, [H, W, 3] in world coordinates."""
        return geometry.unproject(self.depth(name), self.cameras[name])


def transfer_marks(views: FittedViews, events: Sequence[Event], name: str) -> list[Mark]:
    """Return the marks of other views as clicks in one view, where this view shows the marked surface points.

    Each point of a stroke's path becomes a click. A box becomes none, and neither does a point that is hidden in this
    view or outside the picture. A correction of this view leaves pixels unchanged that these clicks confirm.

    Args:
        events: all marks so far; those in the view `name` itself are not used.
        name: the view to which marks are transferred.
    """
    camera, depth, found = views.cameras[name], views.depth(name), []
    for event in events:
        if event.view == name or event.view not in views.cameras or event.mark.is_box:
            continue
        points, inside = geometry.sample_nearest(views.surface(event.view), event.mark.points)
        uv, z = geometry.project(points[inside], camera)
        here, inside = geometry.sample_nearest(depth, uv)
        visible = inside & (z > 0) & (np.abs(here - z) < geometry.SAME_SURFACE * z)
        found += [Mark(at[None], event.mark.positive) for at in uv[visible]]
    return found
