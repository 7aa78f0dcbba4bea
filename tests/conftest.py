"""Fixtures that several test files use."""

import os
import sys
import tempfile
from pathlib import Path

import pytest

# No result of a test depends on which weights lie in the cache of whoever runs it.
os.environ["XDG_CACHE_HOME"] = str(Path(tempfile.gettempdir()) / f"reffusion-tests-{os.getuid()}")

DATA = Path(__file__).parents[1] / "data"


@pytest.fixture(scope="module")
def generate():
    """The module data/generate.py, with its neighbours importable."""
    sys.path.insert(0, str(DATA))
    try:
        import generate

        yield generate
    finally:
        sys.path.remove(str(DATA))


@pytest.fixture(scope="module")
def mini_scene(generate, tmp_path_factory):
    """The folder of the smallest synthetic scene; tests must not change it."""
    folder = tmp_path_factory.mktemp("scene") / "mini"
    generate.generate(folder, 0, generate.KINDS["mini"])
    return folder


@pytest.fixture(scope="module")
def prior():
    """A small random inpainting prior, one for all tests of a module."""
    from scenes.networks import small_prior

    return small_prior()


@pytest.fixture(scope="module")
def text(prior):
    """[3, L, D], hidden states of the global, the local and the empty prompt."""
    import torch

    from reffusion.prior.crops import PROMPTS
    from reffusion.prior.diffusion import embed_text

    with torch.no_grad():
        return embed_text(prior, list(PROMPTS))


@pytest.fixture
def wall_folders(tmp_path):
    """The folders before the stage `reference`, of the wall with a square before it."""
    from scenes.references import write_wall_stages

    return write_wall_stages(tmp_path)


def pytest_collection_modifyitems(items):
    """Run the longest file first: with two processes it would otherwise run alone at the end."""
    items.sort(key=lambda item: item.path.name != "test_resume.py")
