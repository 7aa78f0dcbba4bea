"""Fixtures that several test files use."""

import os
import tempfile
from pathlib import Path

import pytest

# Use an empty cache: no test result may depend on the weights in the cache of the user who runs the tests.
os.environ["XDG_CACHE_HOME"] = str(Path(tempfile.gettempdir()) / f"reffusion-tests-{os.getuid()}")


# The files that run first. Where no kernel is compiled yet, one process compiles those of splats, one those of made
# scenes, and the other files here need none. All processes would else compile the same kernels at once.
FIRST = ("adapted_study", "demo", "batch", "fit", "compare", "bad_input", "capture_files", "runner", "runner_faults")


def pytest_collection_modifyitems(items):
    rank = {f"test_{name}.py": place for place, name in enumerate(FIRST)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))
    if os.environ.get("REFFUSION_SLOW") != "1":
        for item in items:
            if item.get_closest_marker("slow"):
                item.add_marker(pytest.mark.skip(reason="slow; REFFUSION_SLOW=1 runs it"))


@pytest.fixture(scope="module")
def generate():
    """The generator of made scenes."""
    from lab.scenes import generate

    return generate


@pytest.fixture(scope="module")
def mini_scene(generate, tmp_path_factory):
    """The folder of the smallest synthetic scene; tests must not change it."""
    folder = tmp_path_factory.mktemp("scene") / "mini"
    generate.generate(folder, 0, generate.KINDS["mini"])
    return folder


@pytest.fixture(scope="module")
def stages_answer_here():
    """Let this project's stages answer the runner's questions in this process: starting one takes seconds."""
    import json
    from dataclasses import asdict

    from runner import plan, resolve, worker

    answer = lambda root, questions: json.loads(json.dumps([*map(worker._describe, questions)], default=asdict))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(Path(__file__).resolve().parent.parent)
        for module in (plan, resolve):
            patch.setattr(module, "ask_stages", answer)
        yield


@pytest.fixture(scope="module")
def prior():
    """A small inpainting prior with random weights, shared by all tests of a module."""
    from scenes.networks import small_prior

    return small_prior()


@pytest.fixture(scope="module")
def text(prior):
    """The text encoder's hidden states [3, L, D] of the global, the local and the empty prompt."""
    import torch

    from reffusion.params.base import Prompts
    from reffusion.prior.diffusion import embed_text

    with torch.no_grad():
        return embed_text(prior, Prompts().texts)


@pytest.fixture
def wall_folders(tmp_path):
    """The output folders of all stages before `reference`, for a scene with a square in front of a wall."""
    from scenes.references import write_wall_stages

    return write_wall_stages(tmp_path)
