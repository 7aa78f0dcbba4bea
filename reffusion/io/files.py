"""Opens files that a user hands over, and turns everything that is wrong with them into a message of one line."""

from __future__ import annotations

import reprlib
import stat
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

MOST_PIXELS = 200_000_000  # of a picture or depth map; larger ones are refused before memory is allocated
LONGEST_WORD = 400  # characters of a message without a blank


class BadInput(ValueError):
    """Something that a user handed over is wrong: one line that names the file or key and, where possible, the
    remedy."""

    def __init__(self, message: str):
        # Long words, such as a number of two thousand digits, are cut; a path is hardly ever so long.
        super().__init__(" ".join(shorten(word, LONGEST_WORD) for word in " ".join(message.splitlines()).split(" ")))


@contextmanager
def as_bad_input(path: Path, what: str) -> Iterator[None]:
    """Turn every error raised inside into BadInput. Libraries raise dozens of kinds of errors for input that they do
    not understand, so all are caught.

    Args:
        path: the file that is read, for the message; what: what it should be, as in "a readable picture".
    """
    try:
        yield
    except BadInput:
        raise
    except Exception as error:
        message = shorten(" ".join(str(error).split()), 200) or "cut off"
        raise BadInput(f"{path}: not {what} ({type(error).__name__}: {message})") from error


@contextmanager
def reading(path: Path, what: str) -> Iterator[None]:
    """`as_bad_input` for a file that is opened inside: BadInput too where it is missing, a folder, a pipe or
    a device."""
    with as_bad_input(path, what):
        _check_regular(path)
        yield


def _check_regular(path: Path) -> None:
    """BadInput where the path is no regular file: opening a pipe would wait for its other end for ever."""
    try:
        mode = Path(path).stat().st_mode
    except FileNotFoundError:
        raise BadInput(f"{path}: " + ("a link to nothing" if Path(path).is_symlink() else "no such file")) from None
    if not stat.S_ISREG(mode):
        raise BadInput(f"{path}: {'a folder' if stat.S_ISDIR(mode) else 'a pipe or device'}; a file is expected")


def check_pixels(path: Path, width: int, height: int) -> None:
    """BadInput where a picture has no pixel, or more than `MOST_PIXELS`."""
    if width < 1 or height < 1:
        raise BadInput(f"{path}: {width}x{height} px; it has no pixel")
    if width * height > MOST_PIXELS:
        raise BadInput(f"{path}: {width}x{height} px are more than {MOST_PIXELS // 10**6} megapixels; make it smaller")


def is_file(path: Path) -> bool:
    """Does a file of this name exist? BadInput where it is something else, which would otherwise be
    ignored."""
    if path.is_file():
        return True
    if path.exists() or path.is_symlink():
        _check_regular(path)
    return False


def shorten(value: object, most: int = 60) -> str:
    """A value as text for a message, cut after `most` characters."""
    text = value if isinstance(value, str) else reprlib.repr(value)
    return text if len(text) <= most else text[: most - 3] + "..."


class Cursor:
    """A position in a little-endian binary file; BadInput where the file ends before what it declares."""

    def __init__(self, path: Path):
        self.path, self.data, self.at = path, Path(path).read_bytes(), 0

    def read(self, layout: str) -> tuple:
        layout = "<" + layout
        self.need(1, struct.calcsize(layout))
        values = struct.unpack_from(layout, self.data, self.at)
        self.at += struct.calcsize(layout)
        return values

    def need(self, count: int, size: int) -> None:
        """BadInput where fewer than `count` records of `size` bytes follow, before memory is allocated for them."""
        if self.at + count * size > len(self.data):
            raise BadInput(f"{self.path}: cut off at byte {len(self.data)}")

    def count(self, size: int) -> int:
        """Read the number of records that follow, each of at least `size` bytes."""
        (count,) = self.read("Q")
        self.need(count, size)
        return count

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise BadInput(f"{self.path}: cut off at byte {len(self.data)}")
        name, self.at = self.data[self.at : end].decode(), end + 1
        return name

    def end(self) -> None:
        if self.at != len(self.data):
            raise BadInput(f"{self.path}: {len(self.data) - self.at} bytes too many at its end; write the model again")
