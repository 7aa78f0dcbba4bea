"""Export of a finished scene for other tools: `python -m report.export --scene X` (`make scene=X export`)."""

from __future__ import annotations

import shutil
from pathlib import Path

from reffusion.io.cameras import save_cameras
from reffusion.io.compressed import save_compressed
from reffusion.io.files import BadInput
from reffusion.io.lora import save_portable
from reffusion.io.ply import load_ply, save_ply, save_splats
from reffusion.io.scene import has_photograph, load_scene
from reffusion.io.splat_transform import save_for_web
from report import cli
from report.sheet import stage_folder

PLY, COMPRESSED, SPZ, GLB = "scene.ply", "scene.compressed.ply", "scene.spz", "scene.glb"
SOG, HTML = "scene.sog", "scene.html"
WITH_OBJECT = "with_object.ply"
CAMERAS, IMAGES, LORA = "cameras", "images", "lora"
HEADER = 1000  # bytes of the header that contain the type of x
LORA_FILE = "pytorch_lora_weights.safetensors"


def make(home: Path, sog: bool = False) -> list[str]:
    """Write the Gaussians, cameras, photographs and the LoRA in common formats to `home`/export/.

    Gaussians and cameras are in the scene's own frame; in a .spz and a .glb y points up, as their formats say.
    Photographs, the Gaussians of the fit (the scene with the object) and the LoRA are written if they exist.

    Args:
        home: runs/<scene> or runs/<scene>@<variant>, with a finished stage `evaluate`.
        sog: True also writes a .sog and an .html file, which takes Node and minutes.

    Returns:
        Lines of text, one for each written file or folder with its path and a description.

    Raises:
        ValueError: the stage `evaluate` has not run, gsply is not installed, or the .sog or .html file cannot be
            written.
    """
    result, out = home / "evaluate" / PLY, home / "export"
    if not result.exists():
        raise ValueError(f"{result} is missing; `make scene={home.name.split('@')[0]} export` makes it")
    poses = stage_folder(home, "poses")
    scene = load_scene(poses)
    gaussians = load_ply(result, scene.similarity)
    save_compressed(out / COMPRESSED, gaussians, scene.similarity)
    shutil.copyfile(result, out / PLY)
    lines = [f"{out / PLY}: {len(gaussians)} Gaussians of degree {gaussians.sh_degree}, in the scene's own frame"]
    lines[0] += viewer_caveats(result, gaussians.antialiased)
    smaller = lambda name: f"{result.stat().st_size / (out / name).stat().st_size:.1f} times smaller"
    lines.append(f"{out / COMPRESSED}: the same, quantised, {smaller(COMPRESSED)}, in PlayCanvas's format")
    try:
        save_splats(out / SPZ, gaussians, scene.similarity)
        lines.append(f"{out / SPZ}: the same, quantised, {smaller(SPZ)}, in Niantic's format")
    except BadInput as error:  # coordinates too large for the format
        lines.append(f"not written: {error}")
    save_splats(out / GLB, gaussians, scene.similarity)
    lines.append(f"{out / GLB}: the same in glTF, by its extension KHR_gaussian_splatting")
    save_cameras(out / CAMERAS, scene, IMAGES)
    pictured = [name for name in scene.cameras if has_photograph(poses, name)]
    for name in pictured:
        (out / CAMERAS / IMAGES).mkdir(exist_ok=True)
        shutil.copyfile(poses / "images" / f"{name}.png", out / CAMERAS / IMAGES / f"{name}.png")
    pictures = f"{len(pictured)} undistorted photographs" if pictured else "no photographs"
    lines.append(f"{out / CAMERAS}: {len(scene.cameras)} pinholes, a COLMAP model and transforms.json; {pictures}")
    fitted = stage_folder(home, "fit") / "gaussians.ply"
    if fitted.exists():
        save_ply(out / WITH_OBJECT, load_ply(fitted), scene.similarity)
        command_line = f"reffusion patch {out / WITH_OBJECT} AFTER.ply --cameras {out / CAMERAS} --out patched.ply"
        lines.append(
            f"{out / WITH_OBJECT}: the scene with the object, to be edited: delete something in an editor, save the "
            f"rest as AFTER.ply, and `{command_line}` fills the hole"
        )
    adapted = stage_folder(home, "personalize") / LORA_FILE
    if adapted.exists():
        save_portable(adapted, out / LORA / LORA_FILE)
        lines.append(f"{out / LORA / LORA_FILE}: the prior's LoRA, as diffusers' load_lora_weights reads it")
    if sog:  # last, since it may fail
        for name in (SOG, HTML):
            save_for_web(out / name, out / PLY, gaussians.antialiased)
        lines.append(f"{out / SOG}: the same, quantised, {smaller(SOG)}, in PlayCanvas's format for the web")
        lines.append(f"{out / HTML}: a page that shows it in a browser, in one file, without a network")
    else:
        lines.append(f"{out / SOG}, {HTML}: not written; `--sog` (make: `sog=1`) writes both, with Node, in minutes")
    return lines


def viewer_caveats(path: Path, antialiased: bool) -> str:
    """Return text on what viewers may not support in a .ply file: doubles, Mip-Splatting's filter; "" if neither.

    The text is to be appended to a sentence: each of the two parts begins with "; ".

    Args:
        path: the .ply file; its header says whether positions are doubles.
        antialiased: True if its Gaussians were fitted with the 2D filter of Mip-Splatting.
    """
    with open(path, "rb") as file:
        exact = b"property double x" in file.read(HEADER)
    doubles = (
        "; positions are doubles, since floats would move them, but many editors read floats only" if exact else ""
    )
    smoothed = (
        "; made for Mip-Splatting's filter, without which viewers show it slightly thicker" if antialiased else ""
    )
    return doubles + smoothed


@cli.command
def main() -> None:
    """Run `reffusion export`: write the finished scene in all formats, and print what was written."""
    parser = cli.scene_parser("export", __doc__)
    parser.add_argument("--sog", action="store_true", help="also write .sog and .html, by Node's npm (210 MB, minutes)")
    arguments = parser.parse_args()
    print("\n".join(make(cli.run_folder(arguments), arguments.sog)))


if __name__ == "__main__":
    main()
