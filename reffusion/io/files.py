"""Checks and error messages for files that a user supplies: every error becomes `BadInput` with one line of text."""

from __future__ import annotations

import reprlib
import stat
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LFS = b"version https://git-lfs"  # beginning of a pointer that a clone without Git LFS has instead of a file
MOST_PIXELS = 200_000_000  # largest size of a picture or depth map; larger ones are refused before they are read
VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mts", ".3gp", ".insv")  # endings, in lower case
LONGEST_WORD = 400  # characters; longer words of a message are cut


class BadInput(ValueError):
    """An error in what a user supplied: a file, or a key of scene.yaml.

    The message is one line that names the file or key and, where possible, says how to correct the error.
    """

    def __init__(self, message: str):
        # Words longer than LONGEST_WORD, such as a number of two thousand digits, are cut. Paths are shorter.
        super().__init__(" ".join(shorten(word, LONGEST_WORD) for word in " ".join(message.splitlines()).split(" ")))


@contextmanager
def as_bad_input(path: Path, what: str) -> Iterator[None]:
    """Turn every Exception that is raised inside the context into BadInput. A BadInput passes unchanged.

    All kinds of exceptions are caught, because libraries raise dozens of kinds for input that they do not understand.

    Args:
        path: the file that is read, for the message.
        what: what the file should be, for the message, e.g. "a readable picture".
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
    """Check that `path` is a regular file, and turn every exception raised inside the context into BadInput.

    Args:
        path, what: as in `as_bad_input`.

    Raises:
        BadInput: the file is missing, or a folder, pipe or device, or a pointer of Git LFS; or an exception was raised
            inside.
    """
    with as_bad_input(path, what):
        _check_regular(path)
        with open(path, "rb") as file:
            if file.read(len(LFS)) == LFS:
                raise BadInput(f"{path}: a pointer of Git LFS, not the file; download the file by `git lfs pull`")
        yield


def _check_regular(path: Path) -> None:
    """Raise BadInput if the path is no regular file. Opening a pipe, for example, could block for ever."""
    try:
        mode = Path(path).stat().st_mode
    except FileNotFoundError:
        raise BadInput(f"{path}: " + ("a link to nothing" if Path(path).is_symlink() else "no such file")) from None
    if not stat.S_ISREG(mode):
        raise BadInput(f"{path}: {'a folder' if stat.S_ISDIR(mode) else 'a pipe or device'}; a file is expected")


def check_pixels(path: Path, width: int, height: int) -> None:
    """Raise BadInput if a picture of this size in pixels has no pixel, or more than `MOST_PIXELS`."""
    if width < 1 or height < 1:
        raise BadInput(f"{path}: {width}x{height} px; it has no pixel")
    if width * height > MOST_PIXELS:
        raise BadInput(f"{path}: {width}x{height} px are more than {MOST_PIXELS // 10**6} megapixels; make it smaller")


def is_file(path: Path) -> bool:
    """Return whether the path is an existing regular file; False if nothing exists there.

    Raises:
        BadInput: the path exists and is no regular file (e.g. a folder), which would otherwise be ignored silently.
    """
    if path.is_file():
        return True
    if path.exists() or path.is_symlink():
        _check_regular(path)
    return False


def shorten(value: object, most: int = 60) -> str:
    """Return a value as text for a message, with at most `most` characters."""
    text = value if isinstance(value, str) else reprlib.repr(value)
    return text if len(text) <= most else text[: most - 3] + "..."


class Cursor:
    """A reader of a little-endian binary file, which it holds in memory.

    Every method that reads raises BadInput if the file ends too early.

    Attributes:
        path: the file.
        data: its content.
        at: offset in bytes from which the next value is read.
    """

    def __init__(self, path: Path):
        self.path, self.data, self.at = path, Path(path).read_bytes(), 0

    def read(self, layout: str) -> tuple:
        """Return the values of a layout of the module `struct`, given without byte order, and advance beyond them."""
        layout = "<" + layout
        self.check_left(1, struct.calcsize(layout))
        values = struct.unpack_from(layout, self.data, self.at)
        self.at += struct.calcsize(layout)
        return values

    def check_left(self, count: int, size: int) -> None:
        """Raise BadInput if fewer than `count` records of `size` bytes follow. Nothing is read."""
        if self.at + count * size > len(self.data):
            raise BadInput(f"{self.path}: cut off at byte {len(self.data)}; copy or export it again")

    def read_count(self, size: int) -> int:
        """Read and return a count (uint64). Raises BadInput if fewer than so many records of `size` bytes follow."""
        (count,) = self.read("Q")
        self.check_left(count, size)
        return count

    def read_text(self) -> str:
        """Return the UTF-8 text before the next zero byte, and advance beyond this byte."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise BadInput(f"{self.path}: cut off at byte {len(self.data)}; copy or export it again")
        name, self.at = self.data[self.at : end].decode(), end + 1
        return name

    def check_end(self) -> None:
        """Raise BadInput if bytes follow that were not read."""
        if self.at != len(self.data):
            raise BadInput(f"{self.path}: {len(self.data) - self.at} bytes too many at its end; write the model again")
