"""The plug-in for LichtFeld Studio, with a stand-in for the editor's published interface (plug-in API 1)."""

from __future__ import annotations

import importlib.util
import json
import sys
import time
import tomllib
import types
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes.random_scene import random_gaussians
from test_patch_command import sample_room

from reffusion.io.ply import load_ply

pytestmark = pytest.mark.integration

PLUGIN = Path(__file__).resolve().parent.parent / "plugins" / "lichtfeld"
COMMAND = Path(sys.executable).with_name("reffusion")


class Node:
    """A node with splats, as the editor's SceneNode and SplatData in one."""

    def __init__(self, name, gaussians):
        self.name, self.visible, self.transform = name, True, [float(k) for k in range(16)]
        sh = gaussians.sh
        self.means_raw, self.sh0_raw, self.shN_raw = gaussians.means, sh[:, :1], sh[:, 1:]
        self.opacity_raw, self.scaling_raw = gaussians.opacity_logits[:, None], gaussians.log_scales
        self.rotation_raw, self.deleted, self.num_points = gaussians.quaternions, None, len(gaussians)

    def splat_data(self):
        return self

    def has_deleted_mask(self):
        return self.deleted is not None


class Editor(types.ModuleType):
    """The module `lichtfeld`, which holds one scene."""

    def __init__(self, gaussians):
        super().__init__("lichtfeld")
        self.nodes, self.selection_mask, self.classes = {"room": Node("room", gaussians)}, None, []
        self.ui = types.SimpleNamespace(Panel=object, PanelSpace=types.SimpleNamespace(MAIN_PANEL_TAB="tab"))
        self.log = types.SimpleNamespace(error=print)
        self.register_class, self.unregister_class = self.classes.append, self.classes.remove

    def get_scene(self):
        return self

    def get_visible_nodes(self):
        return [node for node in self.nodes.values() if node.visible]

    def get_node(self, name):
        return self.nodes.get(name)

    def has_selection(self):
        return self.selection_mask is not None

    def load_file(self, path):
        self.nodes[Path(path).stem] = Node(Path(path).stem, load_ply(Path(path)))

    def get_node_transform(self, name):
        return self.nodes[name].transform

    def set_node_transform(self, name, matrix):
        self.nodes[name].transform = matrix

    def set_node_visibility(self, name, visible):
        self.nodes[name].visible = visible


class Layout:
    """The argument `ui` of `draw`: it presses one button, and collects what is shown."""

    def __init__(self, program, press=""):
        self.program, self.press, self.shown = str(program), press, []

    def path_input(self, label, value, folder_mode):
        return False, value if folder_mode else self.program

    def button(self, label):
        return label == self.press

    button_styled = lambda self, label, style: self.button(label)
    label = text_disabled = lambda self, text: self.shown.append(text)


@pytest.fixture
def load_plugin(monkeypatch):
    def load(gaussians):
        editor = Editor(gaussians)
        monkeypatch.setitem(sys.modules, "lichtfeld", editor)
        for name in [name for name in sys.modules if name.startswith("reffusion_fill")]:
            monkeypatch.delitem(sys.modules, name)
        where = {"submodule_search_locations": [str(PLUGIN)]}
        spec = importlib.util.spec_from_file_location("reffusion_fill", PLUGIN / "__init__.py", **where)
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, "reffusion_fill", module)
        spec.loader.exec_module(module)
        module.on_load()
        return editor, editor.classes[0](), module

    return load


def press_fill(panel, program) -> str:
    """Press the button, wait until the job has ended, and return the panel's last line."""
    shown = Layout(program, "Fill hole")
    panel.draw(shown)
    while panel._job is not None:
        time.sleep(0.05)
        shown = Layout(program)
        panel.draw(shown)
    panel.draw(shown := Layout(program))
    return shown.shown[-1]


def write_small_job(path: Path) -> Path:
    """Write a program that calls `reffusion` with the words it is given, and with parameters of a small job."""
    small = "poses.longest=96 initialize.refit_steps=20 distill.iterations=4"
    path.write_text(f'#!/bin/sh\nexec "{COMMAND}" "$@" --profile laptop --set "{small}"\n')
    path.chmod(0o755)
    return path


def write_program(path: Path) -> Path:
    """Write a program that stands in for `reffusion`: the filled scene is the one after the deletion."""
    lines = ["#!" + sys.executable, "import shutil, sys", "assert sys.argv[1] == 'patch'", "print('evaluate: done')"]
    path.write_text("\n".join([*lines, "shutil.copy(sys.argv[3], sys.argv[5])"]))
    path.chmod(0o755)
    return path


def test_the_manifest_and_the_market_entry_agree():
    manifest = tomllib.loads((PLUGIN / "pyproject.toml").read_text())
    entry = json.loads((PLUGIN / "market.json").read_text())
    project, host = manifest["project"], manifest["tool"]["lichtfeld"]
    version = entry["versions"][entry["latest_version"]]
    assert (entry["name"], entry["latest_version"]) == (project["name"], project["version"])
    assert version["dependencies"] == project["dependencies"]
    assert {key: version[key] for key in ("plugin_api", "lichtfeld_version", "required_features")} == {
        key: host[key] for key in ("plugin_api", "lichtfeld_version", "required_features")
    }
    assert isinstance(host["hot_reload"], bool)


@pytest.mark.parametrize("how", ["selected", "deleted", "one is deleted, others are selected"])
def test_the_selection_is_filled_and_the_old_node_hidden(load_plugin, tmp_path, how):
    whole = random_gaussians(60, 1)
    editor, panel, module = load_plugin(whole)
    marked = torch.arange(60) < 9
    if how != "deleted":
        editor.selection_mask = marked
    if how != "selected":
        editor.nodes["room"].deleted = marked if how == "deleted" else torch.arange(60) == 59
    last = press_fill(panel, write_program(tmp_path / "program"))
    folder = Path(last.split("filled.ply")[0])
    before, after = load_ply(folder / "before.ply"), load_ply(folder / "after.ply")
    kept = torch.arange(60) < (59 if how.startswith("one") else 60)
    for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh"):
        values = getattr(whole, name)
        assert torch.equal(getattr(before, name), values[kept]), name
        assert torch.equal(getattr(after, name), values[kept & ~marked]), name
    assert not editor.nodes["room"].visible and editor.nodes["filled"].transform == editor.nodes["room"].transform
    assert (folder / "log.txt").read_text() == "evaluate: done\n"
    module.on_unload()
    assert not editor.classes


def test_mistakes_are_one_line(load_plugin, tmp_path):
    editor, panel, _ = load_plugin(random_gaussians(60, 1))
    program = write_program(tmp_path / "program")
    assert press_fill(panel, program) == "select the splats of the object first, or delete them"
    editor.selection_mask = torch.ones(60, dtype=torch.bool)
    assert "nothing is left" in press_fill(panel, program)
    editor.selection_mask = torch.arange(60) < 9
    assert "cannot be started (No such file or directory)" in press_fill(panel, tmp_path / "nothing")
    editor.nodes["other"] = Node("other", random_gaussians(5, 1))
    assert press_fill(panel, program).startswith("2 visible nodes have splats")
    editor.nodes["other"].visible = False
    editor.selection_mask = torch.arange(65) < 9
    assert "splats of other nodes" in press_fill(panel, program)
    assert editor.nodes["room"].visible


def test_what_the_command_refuses_is_shown(load_plugin):
    editor, panel, _ = load_plugin(random_gaussians(60, 1))
    editor.selection_mask = torch.arange(60) < 1  # a single splat leaves no hole
    last = press_fill(panel, COMMAND)
    assert last.startswith("error: ") and "log.txt" in last and editor.nodes["room"].visible


@pytest.mark.slow
def test_the_command_fills_what_is_selected(load_plugin, tmp_path):
    means, deleted = sample_room("back")
    count = len(means)
    made, colors = random_gaussians(count, 0), torch.rand(count, 1, 3, generator=torch.Generator().manual_seed(0))
    scales, opacities = torch.full((count, 3), np.log(0.03)).float(), torch.full((count,), 4.0)
    whole = type(made)(torch.from_numpy(means).float(), made.quaternions, scales, opacities, colors - 0.5)
    editor, panel, _ = load_plugin(whole)
    editor.selection_mask = torch.from_numpy(deleted)
    last = press_fill(panel, write_small_job(tmp_path / "program"))
    assert "in place of room" in last and editor.nodes["filled"].num_points > np.count_nonzero(~deleted)
