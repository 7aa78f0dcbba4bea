"""The panel "Fill hole" of LichtFeld Studio."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import numpy as np

import lichtfeld as lf

from .job import FillJob, read_splats, split_splats, write_splats


def find_node(scene):
    """Return the only visible node with splats.

    Raises:
        ValueError: there is none, or there are several.
    """
    nodes = [node for node in scene.get_visible_nodes() if node.splat_data() is not None] if scene else []
    if len(nodes) != 1:
        raise ValueError(f"{len(nodes)} visible nodes have splats: show the one to fill, and hide or merge the others")
    return nodes[0]


def read_mask(tensor) -> np.ndarray | None:
    """Copy a mask of splats to bool [N]; None if there is none."""
    return None if tensor is None else np.asarray(tensor.cpu().numpy()).reshape(-1).astype(bool)


class FillPanel(lf.ui.Panel):
    """Fills what is selected or deleted, hides the node, and shows the filled one in its place."""

    id = "reffusion_fill.panel"
    label = "Fill hole"
    space = lf.ui.PanelSpace.MAIN_PANEL_TAB
    order = 210

    def __init__(self):
        self._program, self._cameras = shutil.which("reffusion") or "", ""
        self._job, self._node, self._loading, self._message = None, "", False, ""

    def draw(self, ui):
        ui.text_disabled("Select the splats of an object, or delete them.")
        _, self._program = ui.path_input("Command reffusion", self._program, False)
        _, self._cameras = ui.path_input("Cameras and photographs (optional)", self._cameras, True)
        if self._job is None:
            if ui.button_styled("Fill hole", "primary"):
                self._try(self._start)
        else:
            ui.label(self._job.line)
            if not self._loading and ui.button("Stop"):
                self._job.stop()
            self._try(self._show_result)
        if self._message:
            ui.label(self._message)

    def _try(self, action) -> None:
        try:
            action()
        except ValueError as error:
            self._job, self._message = None, str(error)
            lf.log.error(f"RefFusion: {error}")

    def _start(self) -> None:
        scene = lf.get_scene()
        node = find_node(scene)
        data, selected = node.splat_data(), read_mask(scene.selection_mask) if scene.has_selection() else None
        if selected is not None and len(selected) != data.num_points:
            raise ValueError("the selection counts splats of other nodes, too: remove or merge those nodes")
        deleted = read_mask(data.deleted) if data.has_deleted_mask() else None
        before, after = split_splats(data.num_points, selected, deleted)
        folder, splats = Path(tempfile.mkdtemp(prefix="reffusion-")), read_splats(data)
        write_splats(folder / "before.ply", splats, before)
        write_splats(folder / "after.ply", splats, after)
        self._job, self._node, self._loading = FillJob(self._program, folder, self._cameras), node.name, False
        self._message = f"everything is written to {folder}"

    def _show_result(self) -> None:
        status, out = self._job.poll(), self._job.out
        if status is None:
            return
        if status:
            raise ValueError(f"{self._job.line} (all lines: {out.parent / 'log.txt'})")
        if not self._loading:
            lf.load_file(str(out))
            self._loading = True
        if lf.get_scene().get_node(out.stem) is None:  # the editor is still loading it
            return
        lf.set_node_transform(out.stem, lf.get_node_transform(self._node))
        lf.set_node_visibility(self._node, False)
        self._job, self._message = None, f"{out}: in place of {self._node}, which is hidden"
