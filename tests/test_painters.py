"""Painters besides LaMa and MI-GAN: a program, a pipeline of diffusers, Moebius; alone and in the stage."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from safetensors.torch import load_file, save_file
from scenes.images import gradient_image, rectangle_mask
from scenes.networks import save_small_prior
from scenes.painters import save_moebius, save_small_sd3
from scenes.references import write_wall_capture

from reffusion.inpaint import command, exemplar, moebius
from reffusion.io.images import load_image
from reffusion.io.scene import load_mask_sets, load_references, load_scene
from reffusion.params.inpainter import Inpainter
from reffusion.params.reference import Params
from reffusion.prior import pipelines
from reffusion.weights import download
from reffusion.weights.published import MOEBIUS
from runner import Refused
from runner.resolve import Request
from runner.resolve import resolve as prepare_job
from stages import reference
from stages.plan import reference as plan_reference

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parent.parent
SHAPE = (96, 136)
PICTURE = gradient_image(SHAPE, 2, 1)
HOLE = rectangle_mask(SHAPE, (20, 40), (25, 65))

READ = """
import os, sys
import cv2
image, mask = cv2.imread(sys.argv[1]), cv2.imread(sys.argv[2], cv2.IMREAD_GRAYSCALE)
"""
TELEA = READ + "cv2.imwrite(sys.argv[3], cv2.inpaint(image, mask, 3, cv2.INPAINT_TELEA))\n"


def write_program(folder: Path, code: str, *more: str) -> str:
    """Write a Python program into a folder whose name has a space; return the command that runs it."""
    file = folder / "my tools" / "paint.py"
    file.parent.mkdir(exist_ok=True)
    file.write_text(code)
    return " ".join([sys.executable, f"'{file}'", "{image} {mask} {out}", *more])


def run_stage(wall: dict[str, Path], out: Path, **params):
    """Run the stage `reference`; return the picture of the reference, the hole, and the record of candidates."""
    out.mkdir(exist_ok=True)
    reference.run(Params(**params), out, **wall)
    (found,) = load_references(out, load_scene(wall["poses"]))
    pixels = load_mask_sets(wall["masks"], ["a2"])["a2"]
    hole = exemplar.mask_to_paint(pixels.consistent, pixels.invent)
    photo = load_image(wall["poses"] / "images" / "a2.png")
    outside = ~hole & ~pixels.consistent
    assert (found.image[outside] == photo[outside]).all()
    return found.image, hole, json.loads((out / "candidates.json").read_text())


# --------------------------------------------------------------------------------------------------------- a program


def test_a_program_of_opencv_paints_the_reference(wall_folders, tmp_path, capsys):
    setting = {"kind": "command", "command": write_program(tmp_path, TELEA)}
    image, hole, record = run_stage(wall_folders, tmp_path / "out", inpainter=setting, candidates=3)
    assert record["painter"] == f"the program {Path(sys.executable).name}" and len(record["seams"]) == 1
    around = load_image(wall_folders["poses"] / "images" / "a2.png")
    assert np.abs(image[hole].mean(0) - around.reshape(-1, 3).mean(0)).max() < 40, "colors of the wall, not gray or red"
    assert (load_image(tmp_path / "out/candidates.png") == image).all()
    last = capsys.readouterr().out.strip().splitlines()[-1]
    assert "reference/candidates.png" in last and "painted/a2.png" in last


def test_the_prompt_is_one_argument_and_no_shell_reads_it(tmp_path):
    code = TELEA + "open(os.path.join(os.path.dirname(sys.argv[0]), 'said'), 'w').write('|'.join(sys.argv[4:]))\n"
    program = write_program(tmp_path, code, "--prompt={prompt}", "{seed}", "{other}")
    painted = command.paint(program, PICTURE, HOLE, 'a "wall"; touch x $HOME {seed}', 7)
    assert (tmp_path / "my tools/said").read_text() == '--prompt=a "wall"; touch x $HOME {seed}|7|{other}'
    assert (painted[~HOLE] == PICTURE[~HOLE]).all() and (painted[HOLE] != PICTURE[HOLE]).any()


FAULTS = {
    "exit": ("print('loading\\nno memory left\\n', file=sys.stderr); sys.exit(3)", "exit status 3: no memory left"),
    "kill": ("os.kill(os.getpid(), 9)", r"killed by signal 9 \(Killed\)"),
    "nothing": ("print('done', file=sys.stderr)", "wrote no picture to {out}: done"),
    "text": ("open(sys.argv[3], 'w').write('<html>')", "wrote a file to {out} that is no picture: .*out.png"),
    "size": ("cv2.imwrite(sys.argv[3], image[:-1])", "wrote a picture of 136x95 px, not 136x96"),
    "untouched": ("cv2.imwrite(sys.argv[3], image)", "left the hole as it was; it is to paint where {mask} is white"),
    "inverted": ("image[mask == 0] = 9; cv2.imwrite(sys.argv[3], image)", "left the hole as it was"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_program_that_fails_is_refused_in_one_line(tmp_path, fault):
    code, said = FAULTS[fault]
    with pytest.raises(ValueError, match=said) as error:
        command.paint(write_program(tmp_path, READ + code), PICTURE, HOLE, "", 0)
    assert "\n" not in str(error.value) and sys.executable in str(error.value)


def test_a_killed_program_loses_no_candidate(wall_folders, tmp_path, capsys):
    """The program is killed at its second candidate; the stage goes on there, and the sheet shows all three."""
    code = f"""{READ}
log = {str(tmp_path / "seeds")!r}
done = open(log).read() if os.path.exists(log) else ''
open(log, 'w').write(done + sys.argv[4])
if sys.argv[4] == '6' and '6' not in done:
    os.kill(os.getpid(), 9)
image[mask > 0] = (0, 60, 200) if sys.argv[4] == '7' else cv2.mean(image)[:3]
cv2.imwrite(sys.argv[3], image)
"""
    setting = {"kind": "command", "command": write_program(tmp_path, code, "{seed}")}
    options = {"inpainter": setting, "candidates": 3, "seed": 5}
    with pytest.raises(ValueError, match="killed by signal 9"):
        run_stage(wall_folders, tmp_path / "out", **options)
    first = (tmp_path / "out/candidates/0.png").stat().st_mtime_ns
    _, _, record = run_stage(wall_folders, tmp_path / "out", **options)
    assert (tmp_path / "seeds").read_text() == "5667"
    assert (tmp_path / "out/candidates/0.png").stat().st_mtime_ns == first
    height, width = load_image(tmp_path / "out/candidates/0.png").shape[:2]
    assert load_image(tmp_path / "out/candidates.png").shape == (height, 3 * width, 3)
    assert record["chosen"] in (0, 1) and len(record["seams"]) == 3
    last = capsys.readouterr().out.strip().splitlines()[-1]
    assert "3 candidates from left to right" in last and 'set="reference.choose=NUMBER" takes another' in last
    image, hole, record = run_stage(wall_folders, tmp_path / "other", **options, choose=2)
    assert record["chosen"] == 2 and (image[hole] == (200, 60, 0)).all()
    assert (tmp_path / "seeds").read_text() == "56677", "only the one that is asked for"


def test_a_program_that_is_missing_is_known_before_any_work():
    params = Params(inpainter={"kind": "command", "command": "no-such-tool {image} {mask} {out}"}, prompt="a wall")
    (need,) = plan_reference.needed_weights(params, frozenset())
    assert need.problem == "reference.inpainter: no-such-tool is no program that can be started here"
    (note,) = plan_reference.preview(params, scene=Path("/nowhere"))
    assert note == "paints the reference by the program no-such-tool, 1 candidate; the prompt 'a wall' is not read"
    with pytest.raises(ValueError, match="no-such-tool cannot be started: No such file"):
        command.paint(params.inpainter.command, PICTURE, HOLE, "", 0)


def test_a_scene_runs_no_program_but_its_user_may(tmp_path):
    """A scene.yaml comes with photographs of other people."""
    scene, program = write_wall_capture(tmp_path / "wall"), write_program(tmp_path, TELEA)

    def prepared(setting=""):
        return prepare_job(Request(ROOT, tmp_path / "runs", str(scene), profile="laptop", set=setting))

    text = json.dumps({"inpainter": {"kind": "command", "command": program}})
    for content in (text, json.dumps({"stages": {"reference": json.loads(text)}})):
        (scene / "scene.yaml").write_text(content)
        with pytest.raises(Refused, match=r"scene.yaml.*: it names a program to run .*a scene may not do"):
            prepared()
    (scene / "scene.yaml").write_text("")
    setting = f'''reference.inpainter.kind=command "reference.inpainter.command={program}"'''
    job = prepared(setting)
    assert job.params["reference"]["inpainter"]["command"] == program
    (tmp_path / "my tools/paint.py").write_text(TELEA + "# a change\n")
    assert prepared(setting).stages["reference"].machine != job.stages["reference"].machine, "it is painted anew"


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("command", r"kind command needs `command`, such as {kind: command, command: 'mytool {image} {mask} {out}'}"),
        ({"kind": "command", "command": "tool {image} {out}"}, "the command lacks {mask}"),
        ({"kind": "command", "command": "tool '{image} {mask} {out}"}, "cannot be split into words: No closing quot"),
        ({"kind": "lama", "command": "tool {image} {mask} {out}"}, "kind lama takes no `command`, only command"),
        ("pipeline", "kind pipeline needs `weights`, such as {kind: pipeline, weights: owner/model}"),
        ({"kind": "command", "command": "a {image} {mask} {out}", "weights": "x"}, "kind command takes no `weights`"),
        ({"kind": "moebius", "strength": 0.5}, "kind moebius takes no `strength`"),
    ],
)
def test_the_setting_refuses_what_its_kind_does_not_read(value, said):
    with pytest.raises(ValidationError) as refused:
        Params(inpainter=value)
    (error,) = refused.value.errors()
    assert said in error["msg"]


# -------------------------------------------------------------------------------------------- a pipeline of diffusers


@pytest.fixture(scope="module")
def small_pipelines(tmp_path_factory):
    """Folders of small pipelines with random weights: "sd" inpaints, "sd3" is one that makes pictures from text."""
    folder = tmp_path_factory.mktemp("pipelines")
    save_small_prior(folder / "sd")
    save_small_sd3(folder / "sd3")
    return folder


def pipeline_setting(folder, **more):
    return {"kind": "pipeline", "weights": str(folder), "steps": 2, **more}


@pytest.mark.parametrize("name", ["sd", "sd3"])
def test_a_pipeline_paints_the_hole_from_a_seed_and_a_prompt(small_pipelines, name):
    setting = Inpainter(**pipeline_setting(small_pipelines / name, guidance_scale=3))
    paint, other = (pipelines.load_painter(setting, prompt, "cpu", "float32") for prompt in ("a wall", "a red door"))
    painted = paint(PICTURE, HOLE, 1)
    assert painted.dtype == np.uint8 and (painted[~HOLE] == PICTURE[~HOLE]).all()
    assert np.ptp(painted[HOLE].astype(int), axis=0).min() > 0
    noise = np.random.default_rng(0).integers(0, 256, PICTURE.shape, np.uint8)
    assert (paint(np.where(HOLE[..., None], noise, PICTURE), HOLE, 1) == painted).all(), (
        "the hole's content is not read"
    )
    assert (paint(PICTURE, HOLE, 2) != painted).any() and (other(PICTURE, HOLE, 1) != painted).any()


def test_the_stage_draws_candidates_by_a_pipeline(small_pipelines, wall_folders, tmp_path):
    options = {"inpainter": pipeline_setting(small_pipelines / "sd"), "candidates": 2, "prompt": "a wall"}
    image, hole, record = run_stage(wall_folders, tmp_path / "out", **options)
    assert record["painter"] == "the pipeline sd" and len(record["seams"]) == 2
    sheet = load_image(tmp_path / "out/candidates.png")
    first, second = np.split(sheet, 2, axis=1)
    assert (first[hole] != second[hole]).any() and (image == (first, second)[record["chosen"]]).all()
    (note,) = plan_reference.preview(Params(**options), scene=tmp_path)
    assert note == "paints the reference by the pipeline sd, 2 candidates"


def edit(path: Path, **changes):
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def drop_weight(path: Path):
    state = load_file(path)
    state.pop(sorted(state)[0])
    save_file(state, path, metadata={"format": "pt"})


UNET = "unet/diffusion_pytorch_model.safetensors"
WRONG = {
    "another channel": (lambda f: edit(f / "unet/config.json", in_channels=8), "do not fit config.json"),
    "a missing weight": (lambda f: drop_weight(f / UNET), "1 weights are missing, .* first: take a whole copy"),
    "cut short": (lambda f: (f / UNET).write_bytes((f / UNET).read_bytes()[:-9]), "cut short or damaged"),
    "a missing part": (lambda f: shutil.rmtree(f / "vae"), "the folder lacks vae, which model_index.json names"),
    "no index": (lambda f: (f / "model_index.json").unlink(), "model_index.json cannot be read"),
    "a class of the future": (
        lambda f: edit(f / "model_index.json", _class_name="NextInpaintPipeline"),
        "this diffusers has no pipeline NextInpaintPipeline: `pip install -U diffusers`",
    ),
    "a class that does not inpaint": (
        lambda f: edit(f / "model_index.json", _class_name="StableDiffusionUpscalePipeline"),
        "diffusers cannot load it for inpainting: AutoPipeline can't find",
    ),
    "code of the model": (
        lambda f: edit(f / "model_index.json", unet=["unet_code", "MyUNet"]),
        "unet_code.MyUNet is code that comes with the model, and is not run",
    ),
    "an unknown scheduler": (
        lambda f: edit(f / "scheduler/scheduler_config.json", prediction_type="nothing"),
        "StableDiffusionInpaintPipeline failed on a picture of 16x16 px: prediction_type",
    ),
}


@pytest.mark.parametrize("fault", WRONG)
def test_a_pipeline_that_does_not_fit_is_refused_in_one_line(small_pipelines, tmp_path, fault):
    change, said = WRONG[fault]
    folder = tmp_path / "broken"
    shutil.copytree(small_pipelines / "sd", folder)
    change(folder)
    with pytest.raises(ValueError, match=said) as error:
        pipelines.load_painter(Inpainter(**pipeline_setting(folder)), "", "cpu", "float32")(PICTURE, HOLE, 0)
    assert "\n" not in str(error.value)


def test_a_pipeline_is_looked_for_before_any_work_and_fetched_whole(small_pipelines, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HOME", str(tmp_path))
    needs = lambda source: plan_reference.needed_weights(Params(inpainter=pipeline_setting(source)), frozenset())
    (need,) = needs("acme/fill")
    assert "acme/fill is not on this machine" in need.problem and need.can_download
    (need,) = needs(small_pipelines / "sd3")
    assert need.problem is None
    (need,) = needs(tmp_path)
    assert "model_index.json cannot be read" in need.problem and not need.can_download
    folder = small_pipelines / "sd3"
    names = [str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()]
    names += ["text_encoder_3/config.json", "text_encoder_3/model.safetensors", "tokenizer_3/spiece.model"]
    extra = ["flux1-fill-dev.safetensors", "safety_checker/model.safetensors", "README.md"]
    assert set(download.select_files([*names, *extra], False)) == set(names)


# ------------------------------------------------------------------------------------------------------------ Moebius


def test_moebius_samples_as_published(tmp_path):
    """The stand-in's clean latents are .3 (prompt) and .2 (empty) in the hole: guidance 2 must give .4, and 0 .2."""
    folder = save_moebius(tmp_path / "moebius")
    for guidance, expected in ((None, 0.4), (0.0, 0.2)):
        painted = moebius.load(folder, guidance=guidance)(PICTURE, HOLE, 0)
        inside = rectangle_mask(SHAPE, (24, 36), (29, 61))  # enlarging mixes colors along the rim
        assert np.abs(painted[inside] - (expected + 1) / 2 * 255).max() <= 1.5
        assert (painted[~HOLE] == PICTURE[~HOLE]).all()
    paint = moebius.load(folder, steps=4)
    assert (paint(PICTURE, HOLE, 1) == paint(PICTURE, HOLE, 1)).all()


def test_moebius_paints_in_the_stage(wall_folders, tmp_path):
    folder = save_moebius(tmp_path / "moebius")
    setting = {"kind": "moebius", "weights": str(folder), "steps": 3}
    image, hole, record = run_stage(wall_folders, tmp_path / "out", inpainter=setting, candidates=2)
    assert record["painter"] == "Moebius" and len(record["seams"]) == 2
    assert np.abs(np.median(image[hole], axis=0) - 178.5).max() <= 1.5


def test_files_that_are_not_moebius_are_refused_in_one_line(tmp_path):
    folder = save_moebius(tmp_path / "moebius", channels=10)
    expected = (
        r"expected latent float \[B, 9, 64, 64\], timesteps int64 \[B\], .*it takes latent float \[B, 10, 64, 64\]"
    )
    with pytest.raises(ValueError, match=expected):
        moebius.load(folder)
    with pytest.raises(ValueError, match=r"unet.onnx: expected latent float"):
        moebius.load(save_moebius(folder, batch=1))
    with pytest.raises(ValueError, match=r"vae_decoder.onnx: its answer is \[1, 3, 256, 256\], not \[1, 3, 512, 512\]"):
        moebius.load(save_moebius(folder, side=256), steps=1)(PICTURE, HOLE, 0)
    (folder / MOEBIUS.unet).write_text("<html>")
    with pytest.raises(ValueError, match="is no ONNX model that onnxruntime reads"):
        moebius.load(folder)
    (folder / MOEBIUS.unet).unlink()
    params = Params(inpainter={"kind": "moebius", "weights": str(folder)}, prompt="a wall")
    (need,) = plan_reference.needed_weights(params, frozenset())
    assert "holds no unet.onnx: it must hold" in need.problem and not need.can_download
    (need,) = plan_reference.needed_weights(Params(inpainter="moebius"), frozenset())
    assert need.name == MOEBIUS.repo and need.files == MOEBIUS.files and need.can_download
    (note,) = plan_reference.preview(params, scene=tmp_path)
    assert "by Moebius, 4 candidates; the prompt 'a wall' is not read" in note
