"""A finished scene in a browser, to walk through: `python -m report.view --scene demo` (`make scene=X view`).

This machine draws what each visitor's camera sees, with the rasterizer of all other stages: small while it moves, then
in full. So what one sees is what `evaluate` scores, and the browser needs no graphics card.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from reffusion.io.arrays import load_json, load_labels
from reffusion.io.images import to_uint8
from reffusion.io.ply import load_ply
from reffusion.io.scene import has_photograph, load_scene, load_views
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians, Scene, Similarity
from report import command, flight
from report.sheet import stage_folder

PORT = 8080
MOVING, STILL = 180, 480  # px, height of a picture while the camera moves, and once it rests
THUMBNAIL = 160  # px, width of a photograph in its camera
PYRAMID = 0.04  # size of a drawn camera, of the scene's extent 1
TURN = threading.Lock()  # the rasterizer's threads serve one picture at a time


@dataclass(frozen=True)
class Layer:
    """A state of the scene: its Gaussians, and which of them were added, [N] bool."""

    gaussians: Gaussians
    added: Tensor

    def shown(self, there: bool, added: bool) -> Gaussians:
        """Of what was there, and what was added, the asked parts."""
        chosen = (self.added & added) | (~self.added & there)
        return self.gaussians.map(lambda parameter: parameter[chosen])


def layers(home: Path, similarity: Similarity) -> dict[str, Layer]:
    """Title -> layer, the result first; then what it was made from, latest first.

    Args:
        home: runs/<scene> or runs/<scene>@<variant>.
        similarity: the scene's.

    Raises:
        ValueError: the stage `evaluate` has not run.
    """
    finished = home / "evaluate"
    if not (finished / "scene.ply").exists():
        raise ValueError(f"{finished / 'scene.ply'} is missing; {_how(home)} makes it")
    used = {stage for stage, key in load_json(finished / "receipt.json")["needs"].items() if key}
    result = load_ply(finished / "scene.ply", similarity)
    found = {}
    for stage, title in (("distill", "result"), ("initialize", "before distillation"), ("fit", "as photographed")):
        folder = stage_folder(home, stage)
        if stage in used:
            labels, title = folder / "labels.npy", title if found else "result"
            gaussians = load_ply(folder / "gaussians.ply") if found else result
            added = load_labels(labels) if labels.exists() else torch.zeros(len(gaussians), dtype=torch.bool)
            found[title] = Layer(gaussians, added)
    return found


def _how(home: Path) -> str:
    scene, _, variant = home.name.partition("@")
    return f"`make scene={scene}{f' variant={variant}' if variant else ''} all`"


def camera_of(place: Any, height: int) -> Camera:
    """The pinhole view of a visitor's camera: `position` [3], `wxyz` [4] of camera to world, vertical `fov` in radians,
    `aspect` width / height."""
    from scipy.spatial.transform import Rotation

    pose, focal = np.eye(4), height / (2 * np.tan(place.fov / 2))
    pose[:3, :3] = Rotation.from_quat(place.wxyz, scalar_first=True).as_matrix().T
    pose[:3, 3] = -pose[:3, :3] @ place.position
    width = max(1, round(height * place.aspect))
    return Camera("visitor", width, height, focal, focal, width / 2, height / 2, pose)


def picture(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """uint8 [H, W, 3]."""
    with TURN:
        return to_uint8(rasterizer.render(gaussians, camera).color.numpy())


def go_to(place: Any, camera: Camera, target: np.ndarray) -> None:
    """Set a visitor's camera, or everyone's first one, to where a view was photographed.

    What it looks at, and turns around, is as far away as `target` [3].
    """
    place.position = camera.center
    place.look_at = camera.center + camera.world_to_camera[2, :3] * np.linalg.norm(target - camera.center)
    place.fov = field_of_view(camera)


def field_of_view(camera: Camera) -> float:
    """Vertical, in radians; of a principal point beside the centre, that of the lens with it in the centre."""
    return float(2 * np.arctan(camera.height / (2 * camera.fy)))


class Window:
    """The server, what it shows, and a thread for each visitor that draws the latest camera asked for.

    Raises:
        ValueError: viser is not installed, or the scene is not finished.
    """

    def __init__(self, home: Path, port: int = PORT):
        try:
            import viser
        except ImportError:
            raise ValueError("the viewer needs viser: `make scene=X view`, or `pip install viser`") from None
        poses = home.with_name(home.name.split("@")[0]) / "poses"
        if not poses.is_dir():
            raise ValueError(f"{poses} is missing; {_how(home)} makes it")
        scene = load_scene(poses)
        self.layers = layers(home, scene.similarity)
        self.shown = next(iter(self.layers.values())).gaussians
        self.asked: dict[int, threading.Event] = {}
        self.open = True
        self.server = viser.ViserServer(host="127.0.0.1", port=port, label=home.name, verbose=False)
        self._choices()
        self._cameras(scene, load_views(poses, [name for name in scene.train if has_photograph(poses, name)]))
        self.server.on_client_connect(self._visit)
        self.server.on_client_disconnect(lambda client: self._ask(client.client_id))

    def _choices(self) -> None:
        gui = self.server.gui
        state = gui.add_dropdown("scene", list(self.layers), initial_value=next(iter(self.layers)))
        there, added = (gui.add_checkbox(f"what was {kind}", True) for kind in ("there", "added"))

        def changed(_: Any) -> None:
            self.shown = self.layers[state.value].shown(there.value, added.value)
            for visitor in list(self.asked):
                self._ask(visitor)

        for choice in (state, there, added):
            choice.on_update(changed)

    def _cameras(self, scene: Scene, photos: dict[str, np.ndarray]) -> None:
        """Every training view as a pyramid with its photograph, where it has one; a click takes the visitor there."""
        train, drawn, add = [scene.cameras[name] for name in scene.train], [], self.server.scene.add_camera_frustum
        target = flight.focus(train, scene.points)
        self.server.scene.set_up_direction(-np.mean([camera.world_to_camera[1, :3] for camera in train], 0))
        go_to(self.server.initial_camera, train[len(train) // 2], target)
        shown = self.server.gui.add_checkbox("cameras", False)
        for camera in train:
            step = max(1, camera.width // THUMBNAIL)
            small = photos[camera.name][::step, ::step] if camera.name in photos else None
            place = {"wxyz": _quaternion(camera.world_to_camera[:3, :3].T), "position": camera.center}
            lens = {"fov": field_of_view(camera), "aspect": camera.width / camera.height}
            size = {"scale": PYRAMID, "thickness": PYRAMID / 40}
            drawn.append(add(f"/cameras/{camera.name}", **lens, **place, **size, image=small, visible=False))
            drawn[-1].on_click(lambda event, camera=camera: go_to(event.client.camera, camera, target))

        @shown.on_update
        def _(_: Any) -> None:
            for frustum in drawn:
                frustum.visible = shown.value

    def _visit(self, client: Any) -> None:
        self.asked[client.client_id] = threading.Event()
        threading.Thread(target=self._draw, args=(client,), daemon=True).start()
        client.camera.on_update(lambda _: self._ask(client.client_id))
        self._ask(client.client_id)

    def _ask(self, visitor: int) -> None:
        if visitor in self.asked:
            self.asked[visitor].set()

    def _draw(self, client: Any) -> None:
        """Draw for one visitor until he leaves: at once in little, and in full when nothing else is asked meanwhile."""
        asked = self.asked[client.client_id]
        while self.open and client.client_id in self.server.get_clients():
            asked.wait(1.0)
            for height in (MOVING, STILL) if asked.is_set() else ():
                asked.clear()
                drawn = picture(self.shown, camera_of(client.camera, height))
                client.scene.set_background_image(drawn, format="jpeg", jpeg_quality=90)
                if asked.is_set():
                    break
        self.asked.pop(client.client_id, None)

    def close(self) -> None:
        self.open = False
        self.server.stop()


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """[4], wxyz."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)


def main() -> None:
    parser = command.parser("view", __doc__)
    parser.add_argument("--port", type=int, default=PORT, help="the next free one is taken where it is not free")
    arguments = parser.parse_args()
    try:
        window = Window(command.home(arguments), arguments.port)
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None
    print(f"http://127.0.0.1:{window.server.get_port()}  (Ctrl-C ends)", flush=True)
    try:
        window.server.sleep_forever()
    except KeyboardInterrupt:
        window.close()


if __name__ == "__main__":
    main()
