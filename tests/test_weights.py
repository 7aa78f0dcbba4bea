"""Network weights: found in each folder layout without internet access, a message for each fault, and downloads."""

import hashlib
import http.server
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save, save_file

from reffusion.prior.model import load_prior
from reffusion.weights import download, local, published

ROOT = Path(__file__).resolve().parent.parent
TINY = ROOT / "priors" / "tiny"
PARTS = ("unet", "vae", "text_encoder", "tokenizer", "scheduler")


@pytest.fixture
def isolated_machine(tmp_path, monkeypatch):
    """Empty caches, an empty working directory, and no internet access."""
    for name in ("HF_HUB_CACHE", "HF_HUB_OFFLINE", "TORCH_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hub"))
    monkeypatch.setattr(local, "LPIPS_PACKAGES", {})
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")

    def refuse(*_):
        raise AssertionError("the network was asked")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    return tmp_path


def copy_prior(target: Path) -> Path:
    target.mkdir(parents=True)
    for part in PARTS:
        shutil.copytree(TINY / part, target / part)
    shutil.copy(TINY / "model_index.json", target)
    return target


def write_hub_entry(tmp_path, name="acme/paint", state="0123abc", main=True) -> Path:
    """Write a model to the hub's cache; return the entry's folder."""
    entry = tmp_path / "hub" / "hub" / f"models--{name.replace('/', '--')}"
    copy_prior(entry / "snapshots" / state)
    if main:
        (entry / "refs").mkdir()
        (entry / "refs" / "main").write_text(state)
    return entry


# ------------------------------------------------------------------------------------------------------ where they lie


def test_an_id_is_found_in_the_hub_cache_and_loaded_without_a_network(isolated_machine):
    entry = write_hub_entry(isolated_machine)
    assert local.locate("acme/paint") == entry / "snapshots" / "0123abc"
    prior = load_prior("acme/paint")
    assert prior.native_size == 64 and load_prior(entry).native_size == 64


def test_the_state_that_main_names_is_taken(isolated_machine):
    entry = write_hub_entry(isolated_machine, main=False)
    assert local.locate("acme/paint") == entry / "snapshots" / "0123abc"  # the only one
    (entry / "snapshots" / "0456def").mkdir()
    assert local.locate("acme/paint") is None
    (entry / "refs").mkdir()
    (entry / "refs" / "main").write_text("0456def\n")
    assert local.locate("acme/paint").name == "0456def"


def test_an_id_is_found_as_a_folder_here_and_in_the_projects_cache(isolated_machine):
    mine = copy_prior(isolated_machine / "cache" / "reffusion" / "acme" / "paint")
    assert local.locate("acme/paint") == mine
    here = copy_prior(isolated_machine / "elsewhere" / "acme" / "paint")
    assert local.locate("acme/paint").resolve() == here


def test_the_hubs_own_variables_are_read(isolated_machine, monkeypatch):
    assert local.hub_cache() == isolated_machine / "hub" / "hub"
    monkeypatch.setenv("HF_HUB_CACHE", str(isolated_machine / "other"))
    assert local.hub_cache() == isolated_machine / "other"


def test_missing_weights_are_reported_at_once_with_alternatives(isolated_machine):
    with pytest.raises(
        ValueError, match=r"prior priors/tiny is not on this machine: no folder .*elsewhere/priors/tiny"
    ):
        load_prior("priors/tiny")
    with pytest.raises(ValueError, match=r"run `make weights`.*stable-diffusion-v1-5/stable-diffusion-inpainting"):
        load_prior(published.SD2)
    for wrong in (isolated_machine / "absent", "./absent", "three/part/name", "~/absent"):
        with pytest.raises(ValueError, match="no such folder"):
            load_prior(wrong)


def test_half_precision_files_alone_are_enough(isolated_machine):
    folder = copy_prior(isolated_machine / "half")
    (folder / "unet" / "diffusion_pytorch_model.safetensors").rename(
        folder / "unet" / "diffusion_pytorch_model.fp16.safetensors"
    )
    prior = load_prior(folder, dtype=torch.bfloat16)
    assert prior.dtype == torch.bfloat16 and next(prior.vae.parameters()).dtype == torch.float32


# -------------------------------------------------------------------------------------------------------- what is wrong


def edit_json(path: Path, **changes) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def truncate_to_share(path: Path, keep: float) -> None:
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])


def drop_weight(path: Path) -> None:
    state = load_file(path)
    state.pop(sorted(state)[0])
    save_file(state, path, metadata={"format": "pt"})


UNET, VAE, TEXT = "unet/config.json", "vae/config.json", "text_encoder/config.json"
WRONG = {
    "a part is missing": (lambda f: shutil.rmtree(f / "vae"), "lacks vae; it must be a diffusers pipeline folder"),
    "cut short": (
        lambda f: truncate_to_share(f / "unet/diffusion_pytorch_model.safetensors", 0.9),
        r"unet/diffusion_pytorch_model.safetensors is cut short.*make weights",
    ),
    "cut to nothing": (lambda f: truncate_to_share(f / "text_encoder/model.safetensors", 0), "no readable header"),
    "a web page": (lambda f: (f / "text_encoder/model.safetensors").write_text("<html>" * 9), "no readable header"),
    "no safetensors": (lambda f: (f / "text_encoder/model.safetensors").unlink(), "no .safetensors file there"),
    "no configuration": (lambda f: (f / VAE).write_text("{"), r"vae/config.json cannot be read"),
    "no inpainting model": (lambda f: edit_json(f / UNET, in_channels=4), "takes 4 channels.*takes 9"),
    "parts of two models": (
        lambda f: edit_json(f / TEXT, hidden_size=32),
        "text of width 64, the text encoder gives 32",
    ),
    "unknown prediction": (
        lambda f: edit_json(f / "scheduler/scheduler_config.json", prediction_type="sample"),
        "prediction_type 'sample' is not supported; epsilon and v_prediction are",
    ),
    "shapes of the UNet": (
        lambda f: edit_json(f / UNET, block_out_channels=[32, 64, 128]),
        "unet: the weights do not fit",
    ),
    "shapes of the text encoder": (
        lambda f: edit_json(f / TEXT, intermediate_size=96),
        "text_encoder: the weights do not",
    ),
    "a weight is missing": (lambda f: drop_weight(f / "text_encoder/model.safetensors"), "1 weights are missing"),
    "a weight of the UNet is missing": (
        lambda f: drop_weight(f / "unet/diffusion_pytorch_model.safetensors"),
        "unet: .*missing",
    ),
    "half an SDXL": (
        lambda f: edit_json(f / UNET, addition_embed_type="text_time"),
        "neither Stable Diffusion nor SDXL",
    ),
}


@pytest.mark.parametrize("spoil, message", WRONG.values(), ids=WRONG)
def test_each_fault_has_its_message(isolated_machine, spoil, message):
    folder = copy_prior(isolated_machine / "faulty")
    spoil(folder)
    with pytest.raises(ValueError, match=rf"prior (?s:.*){message}"):
        load_prior(folder)


def test_a_lost_shard_is_named(isolated_machine):
    folder = copy_prior(isolated_machine / "shards")
    index = folder / "unet" / "diffusion_pytorch_model.safetensors.index.json"
    index.write_text(json.dumps({"weight_map": {"a": "diffusion_pytorch_model-00001-of-00002.safetensors"}}))
    with pytest.raises(ValueError, match=r"00001-of-00002.safetensors is missing"):
        local.check(folder)


def test_weights_needed_by_a_stage(isolated_machine):
    need = local.model_need(published.SD2, "float16")
    assert "not on this machine" in need.problem and need.can_download and 2.5e9 < need.bytes < 2.7e9
    folder = copy_prior(isolated_machine / "good")
    assert local.model_need(str(folder), "float32").problem is None
    shutil.rmtree(folder / "unet")
    broken = local.model_need(str(folder), "float32")
    assert "lacks unet" in broken.problem and not broken.can_download
    assert "no weights of alex and vgg" in local.lpips_need().problem and local.lpips_need().optional
    own = isolated_machine / "cache" / "reffusion" / "lpips"
    own.mkdir(parents=True)
    for name in ("alex.safetensors", "vgg.pth"):  # whole, and half of a pair
        (own / name).write_bytes(b"x")
    assert "no weights of vgg on" in local.lpips_need().problem
    (own / "vgg16-own.pth").write_bytes(b"x")
    assert local.lpips_need().problem is None


# ------------------------------------------------------------------------------------------------------------- fetching


def test_one_set_of_weights_a_part_is_chosen():
    names = ["model_index.json", "README.md", "sd.ckpt", "sd.safetensors", "unet/config.json", "vae/config.json",
             "unet/diffusion_pytorch_model.safetensors", "unet/diffusion_pytorch_model.fp16.safetensors",
             "unet/diffusion_pytorch_model.bin", "unet/diffusion_pytorch_model.non_ema.safetensors",
             "vae/diffusion_pytorch_model.safetensors", "text_encoder/config.json",
             "text_encoder/model.fp16.safetensors", "tokenizer/vocab.json", "tokenizer/merges.txt",
             "scheduler/scheduler_config.json", "safety_checker/model.safetensors"]  # fmt: skip
    half, full = set(download.select_files(names, True)), set(download.select_files(names, False))
    assert half - full == {"unet/diffusion_pytorch_model.fp16.safetensors"}
    assert full - half == {"unet/diffusion_pytorch_model.safetensors"}
    assert half & full == {"model_index.json", "unet/config.json", "vae/config.json", "text_encoder/config.json",
                           "vae/diffusion_pytorch_model.safetensors", "text_encoder/model.fp16.safetensors",
                           "tokenizer/vocab.json", "tokenizer/merges.txt",
                           "scheduler/scheduler_config.json"}  # fmt: skip
    assert download.select_files(["config.json", "model.safetensors", "a.bin"], True) == [
        "config.json",
        "model.safetensors",
    ]
    assert download.select_files(["config.json", "pytorch_model.bin"], True) == []


class Hub(http.server.BaseHTTPRequestHandler):
    """A local model hub that answers the requests of downloads; one of its models is gated.

    Attributes:
        models: name -> file -> bytes.
        spoilt: files that are sent with one wrong byte.
        stalls: files of which only the first half is sent.
        ranges: nonzero start positions of the range requests so far.
    """

    STATE = "a" * 40

    def _answer(self, code, body=b"", **headers):
        self.send_response(code)
        for name, value in {"Content-Length": str(len(body)), **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def do_GET(self):
        path = self.path.partition("?")[0]
        if "acme/gated" in path:
            return self._answer(403, X_Error_Code="GatedRepo", X_Error_Message="Access is restricted")
        model = next((name for name in self.models if name in path), None)
        if model is None:
            return self._answer(404, X_Error_Code="RepoNotFound", X_Error_Message="Repository Not Found")
        files = self.models[model]
        digest = lambda body: hashlib.sha256(body).hexdigest()
        described = [
            {"rfilename": n, "path": n, "type": "file", "size": len(body), "oid": "0" * 40, "blobId": "0" * 40}
            | ({"lfs": {"sha256": digest(body), "size": len(body), "oid": digest(body), "pointerSize": 1}}
               if n.endswith((".safetensors", ".onnx")) else {})
            for n, body in files.items()
        ]  # fmt: skip
        if "/tree/" in path:
            return self._answer(200, json.dumps(described).encode(), Content_Type="application/json")
        if path.startswith("/api/"):
            asked = path.partition("/revision/")[2]
            if asked == "f" * 40:
                return self._answer(404, X_Error_Code="RevisionNotFound", X_Error_Message="Revision Not Found")
            facts = {"id": model, "sha": asked or self.STATE, "siblings": described, "private": False, "tags": []}
            return self._answer(200, json.dumps(facts).encode(), Content_Type="application/json")
        name = path.partition("/resolve/")[2].partition("/")[2]
        body = files[name]
        headers = {
            "ETag": f'"{digest(body)}"',
            "X_Repo_Commit": path.partition("/resolve/")[2].partition("/")[0],
            "X_Linked_Etag": f'"{digest(body)}"',
        }
        if name in self.spoilt:
            body = body[:-1] + bytes([body[-1] ^ 1])
        first = int(self.headers.get("Range", "bytes=0-").removeprefix("bytes=").split("-")[0])
        if first and self.command == "GET":
            self.ranges.append(first)
            headers["Content_Range"] = f"bytes {first}-{len(body) - 1}/{len(body)}"
        if name in self.stalls and self.command == "GET":
            self.send_response(200)
            for header, value in {"Content-Length": str(len(body)), **headers}.items():
                self.send_header(header.replace("_", "-"), value)
            self.end_headers()
            self.wfile.write(body[: len(body) // 2])
            self.wfile.flush()
            return self.stalled.wait(60)
        return self._answer(206 if first else 200, body[first:], **headers)

    do_HEAD = do_GET

    def log_message(self, *_):
        pass


@pytest.fixture
def hub():
    """The address of a local hub, and its handler class."""
    tiny = {p.relative_to(TINY).as_posix(): p.read_bytes() for p in sorted(TINY.rglob("*"))
            if p.suffix in (".json", ".safetensors")}  # fmt: skip
    fields = {"models": {"acme/paint": tiny}, "spoilt": set(), "stalls": set(), "ranges": []}
    handler = type("Handler", (Hub,), {**fields, "stalled": threading.Event()})
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}", handler
    handler.stalled.set()
    server.shutdown()
    server.server_close()


FETCH = """
import sys
from reffusion.weights import download
for name in sys.argv[1:]:
    try:
        print(download.download_model(name, True))
    except ValueError as error:
        print(error)
"""


def fetch_models(*names, **environment) -> list[str]:
    """Download these models in a new process, which reads the hub's address; return the lines of its output."""
    variables = {k: v for k, v in os.environ.items() if not k.startswith("HF_")} | environment
    variables |= {"PYTHONPATH": str(ROOT), "HF_HUB_DISABLE_XET": "1", "HF_HUB_ETAG_TIMEOUT": "2"}
    done = subprocess.run(
        [sys.executable, "-c", FETCH, *names], env=variables, text=True, capture_output=True, check=True
    )
    return done.stdout.strip().splitlines()


def test_a_model_is_fetched_from_the_hub_and_each_refusal_has_its_message(tmp_path, monkeypatch, hub):
    messages = fetch_models(
        "acme/paint", "acme/gated", "acme/gone", published.SD2, HF_ENDPOINT=hub[0], HF_HOME=str(tmp_path)
    )
    folder, gated, gone, moved = messages
    monkeypatch.delenv("HF_HUB_CACHE", raising=False)
    monkeypatch.setenv("HF_HOME", str(tmp_path))
    assert local.locate("acme/paint") == Path(folder)
    local.check(Path(folder))
    assert "acme/gated is gated: accept its terms" in gated and "hf auth login" in gated
    assert "acme/gone: the hub has no such model" in gone
    assert "the hub has no such model" in moved and "stable-diffusion-v1-5/stable-diffusion-inpainting" in moved


def test_a_revision_is_pinned_or_that_of_the_first_download(tmp_path, hub):
    address, handler = hub
    handler.models[published.SD2] = handler.models["acme/paint"]
    fetch = lambda: [
        Path(line) for line in fetch_models("acme/paint", published.SD2, HF_ENDPOINT=address, HF_HOME=str(tmp_path))
    ]
    first, pinned = fetch()
    assert (first.name, pinned.name) == ("a" * 40, published.REVISIONS[published.SD2])
    handler.STATE = "b" * 40  # the model has a newer revision now
    (first / "model_index.json").unlink()
    assert fetch() == [first, pinned] and (first / "model_index.json").exists()
    (first.parents[1] / "refs" / "main").write_text("f" * 40)
    (message,) = fetch_models("acme/paint", HF_ENDPOINT=address, HF_HOME=str(tmp_path))
    assert "acme/paint: the hub has no revision ffff" in message


@pytest.mark.integration
def test_weights_of_the_laptop_are_fetched_killed_resumed_and_checked(tmp_path, hub):
    """What `make weights painter=moebius` lists (LaMa, MI-GAN, Moebius, Depth Anything) is downloaded from a hub."""
    address, handler = hub
    small = {
        "config.json": b"{}",
        "preprocessor_config.json": b"{}",
        "model.safetensors": save({"x": torch.rand(1000)}),
    }
    painters = {
        each.repo: {each.file: os.urandom(25_000_000), "README.md": b"x"} for each in published.PAINTERS.values()
    }
    moebius = {name: os.urandom(100_000) for name in (*published.MOEBIUS.files, "README.md")}
    handler.models |= {published.DEPTH_ANYTHING: small, published.MOEBIUS.repo: moebius, **painters}
    lama, migan = published.PAINTERS.values()
    home = tmp_path / "cache" / "reffusion" / "lpips"
    home.mkdir(parents=True)
    for name in ("alex", "vgg"):  # from another server: tests/test_lpips.py
        (home / f"{name}.safetensors").touch()
    variables = {k: v for k, v in os.environ.items() if not k.startswith("HF_")}
    variables |= {"HF_ENDPOINT": address, "HF_HOME": str(tmp_path / "hub"), "XDG_CACHE_HOME": str(tmp_path / "cache"),
                  "HF_HUB_DISABLE_XET": "1", "HF_HUB_DOWNLOAD_TIMEOUT": "60"}  # fmt: skip
    command = [sys.executable, "-m", "runner", "weights", "--profile", "laptop", "--runs", str(tmp_path / "runs")]
    command += ["--set", " reference.inpainter=moebius"]  # as `make weights painter=moebius` writes it
    begin = lambda: subprocess.Popen(command, cwd=ROOT, env=variables, text=True, stdout=subprocess.PIPE,
                                     stderr=subprocess.PIPE, start_new_session=True)  # fmt: skip
    half = lambda: max((p.stat().st_size for p in (tmp_path / "hub").rglob("*.part")), default=0)

    handler.stalls.add(lama.file)
    process = begin()
    deadline = time.monotonic() + 60
    while half() < 10_000_000:
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    handler.stalls.clear()
    handler.spoilt.add(migan.file)
    process = begin()
    out, errors = process.communicate(timeout=120)
    assert process.returncode == 0 and f"{migan.file} arrived damaged" in errors, errors
    assert "the job runs without it" in errors, "stages could use it, and do not need it"
    assert re.search(r"to fetch +208 MB +Carve/LaMa-ONNX", out) and out.index("to fetch: about") < out.index("fetched")
    assert handler.ranges and min(handler.ranges) >= 10_000_000, "it went on where it was killed"
    handler.spoilt.clear()
    process = begin()
    out, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    for repo, files in handler.models.items():
        for name in files if repo != "acme/paint" else ():
            found = list((tmp_path / "hub").glob(f"hub/models--{repo.replace('/', '--')}/snapshots/*/{name}"))
            assert [path.read_bytes() for path in found] == ([files[name]] if name != "README.md" else [])


def test_missing_network_and_offline_mode_have_their_messages(tmp_path):
    (unreachable,) = fetch_models("acme/paint", HF_ENDPOINT="http://127.0.0.1:9", HF_HOME=str(tmp_path))
    assert "acme/paint: the hub does not answer" in unreachable and "copy its cache" in unreachable
    (offline,) = fetch_models("acme/paint", HF_HUB_OFFLINE="1", HF_HOME=str(tmp_path))
    assert "HF_HUB_OFFLINE is set" in offline
