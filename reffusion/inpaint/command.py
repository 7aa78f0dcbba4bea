"""2D inpainting by a program of the user."""

from __future__ import annotations

import re
import signal
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from reffusion.inpaint.classical import paste_hole
from reffusion.io.images import load_image, save_image, save_mask
from reffusion.params.inpainter import split_command


def paint(command: str, image: np.ndarray, hole: np.ndarray, prompt: str, seed: int) -> np.ndarray:
    """Return the image with its hole as a program paints it.

    The program is run without a shell, in the working directory, with files in a folder that is removed afterwards.

    Args:
        command: the program and its arguments, see `params.inpainter.Inpainter`.
        image: uint8 [H, W, 3], as the program gets it.
        hole: bool [H, W], the pixels to paint, at least one.
        prompt, seed: the values of {prompt} and {seed}.

    Returns:
        uint8 [H, W, 3]. Pixels outside the hole are unchanged.

    Raises:
        ValueError: the program cannot be started, fails, is killed, or writes no picture, one of another size, or one
            whose hole is as it was. The message is one line with the last line that the program wrote to stderr.
    """
    words = split_command(command)
    with tempfile.TemporaryDirectory(prefix="reffusion-") as name:
        folder = Path(name)
        paths = {key: folder / f"{key}.png" for key in ("image", "mask", "out")}
        save_image(paths["image"], image)
        save_mask(paths["mask"], hole)
        values = {**{key: str(path) for key, path in paths.items()}, "prompt": prompt, "seed": str(seed)}
        said = _run([_fill(word, values) for word in words])
        picture = _read(words[0], paths["out"], said)
    if picture.shape != image.shape:
        sizes = ["x".join(map(str, each.shape[1::-1])) for each in (picture, image)]
        raise ValueError(f"{words[0]} wrote a picture of {sizes[0]} px, not {sizes[1]}{said}")
    if np.array_equal(picture[hole], image[hole]):
        raise ValueError(f"{words[0]} left the hole as it was; it is to paint where {{mask}} is white{said}")
    return paste_hole(image, picture, hole)


def _fill(word: str, values: dict[str, str]) -> str:
    """Return a word of the command with its placeholders {name} replaced; those without a value stay as they are."""
    return re.sub(r"\{(\w+)\}", lambda match: values.get(match[1], match[0]), word)


def _run(words: list[str]) -> str:
    """Run a program, and return ": " and the last line of its stderr, "" without one; raise ValueError if it fails."""
    try:
        done = subprocess.run(words, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, check=False)
    except OSError as error:
        raise ValueError(f"{words[0]} cannot be started: {error.strerror or error}") from None
    lines = [line.strip() for line in done.stderr.decode(errors="replace").splitlines() if line.strip()]
    said = f": {lines[-1][-200:]}" if lines else ""
    if done.returncode < 0:
        raise ValueError(
            f"{words[0]} was killed by signal {-done.returncode} ({signal.strsignal(-done.returncode)}){said}"
        )
    if done.returncode:
        raise ValueError(f"{words[0]} failed with exit status {done.returncode}{said}")
    return said


def _read(program: str, path: Path, said: str) -> np.ndarray:
    """Read the picture that a program wrote; raises ValueError if there is none that can be read."""
    if not path.is_file():
        raise ValueError(f"{program} wrote no picture to {{out}}{said}")
    try:
        return load_image(path)
    except ValueError as error:
        raise ValueError(f"{program} wrote a file to {{out}} that is no picture: {error}{said}") from None
