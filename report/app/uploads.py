"""Files that the user drops on the page: photographs or a video become a new scene in data/.

A file is received under a temporary name, decoded, and only then renamed. No name of a file or folder comes from a
request unchanged.
"""

from __future__ import annotations

import re
from collections.abc import AsyncIterator
from pathlib import Path
from uuid import uuid4

import cv2
from starlette.concurrency import run_in_threadpool

from reffusion.command import root, workplace
from reffusion.io.files import VIDEOS
from reffusion.io.images import ENDINGS, load_thumbnail
from report.app.security import TooLarge

PICTURE_BYTES, VIDEO_BYTES = 100_000_000, 4_000_000_000
MAX_PICTURES = 2000
NAME = re.compile(r"[^\w.+-]+")  # characters that become "_" in names of files and scenes
TEMPORARY = ".uploading-"  # prefix of names of unfinished files


def clean_name(name: str) -> str:
    """Return the name of a file or scene with plain characters only and without folders; "" if none is left."""
    return NAME.sub("_", name.replace("\\", "/").rsplit("/", 1)[-1]).strip("._")[:80]


class Upload:
    """A new scene that receives files.

    Args:
        name: the wished name; a number is added if there is such a scene.

    Raises:
        ValueError: the name has no usable character.
    """

    def __init__(self, name: str):
        clean = clean_name(name)
        if not clean:
            raise ValueError(f"{name!r}: a scene's name needs letters or digits")
        self.data = workplace(root()) / "data"
        taken = lambda each: (self.data / each).exists() or any((self.data / f"{each}{v}").exists() for v in VIDEOS)
        self.name = next(n for n in (clean, *(f"{clean}-{k}" for k in range(2, 1000))) if not taken(n))
        self.scene: Path | None = None  # the folder or video, once a file is there
        self.count = 0
        self._names: dict[str, str] = {}  # name of a picture's file here -> name of the user's file

    async def receive(self, name: str, parts: AsyncIterator[bytes]) -> None:
        """Receive a picture or a video.

        Args:
            name: name of the user's file.
            parts: its content.

        Raises:
            ValueError: the ending is unknown, the content is no picture or video, or there are too many pictures.
            TooLarge: the file is too large.
        """
        clean = clean_name(name)
        ending = Path(clean).suffix.lower()
        if ending not in (*ENDINGS, *VIDEOS):
            raise ValueError(f"{name}: neither a picture ({', '.join(ENDINGS)}) nor a video ({', '.join(VIDEOS)})")
        is_video = ending in VIDEOS
        if self.count >= MAX_PICTURES or (self.scene is not None and is_video == self.scene.is_dir()):
            raise ValueError(f"{name}: drop either one video or up to {MAX_PICTURES} photographs")
        if not is_video:
            clean = self._free_name(clean, name)
        place = self.data / f"{self.name}{ending}" if is_video else self.data / self.name / "images" / clean
        partial = place.with_name(f"{TEMPORARY}{uuid4().hex}{ending}")
        place.parent.mkdir(parents=True, exist_ok=True)
        try:
            await _write(partial, parts, VIDEO_BYTES if is_video else PICTURE_BYTES)
            await run_in_threadpool(_check_video if is_video else _check_picture, partial, name)
            partial.replace(place)
        finally:
            partial.unlink(missing_ok=True)
            if not is_video and not any(place.parent.iterdir()):
                place.parent.rmdir()
                place.parent.parent.rmdir()
        self.scene, self.count = place if is_video else self.data / self.name, self.count + 1

    def _free_name(self, clean: str, name: str) -> str:
        """Return a picture's name, numbered if another file of the user has it, as a_b.jpg of "a b.jpg"."""
        path, number = Path(clean), 1
        while self._names.setdefault(clean, name) != name:
            number += 1
            clean = f"{path.stem}-{number}{path.suffix}"
        return clean


async def _write(path: Path, parts: AsyncIterator[bytes], limit: int) -> None:
    """Write the received parts to a file; raises TooLarge if they have more than `limit` bytes."""
    size = 0
    with open(path, "wb") as file:
        async for part in parts:
            size += len(part)
            if size > limit:
                raise TooLarge(f"larger than {limit // 1_000_000} MB")
            file.write(part)


def _check_picture(path: Path, name: str) -> None:
    """Raise ValueError, which names the user's file `name`, if a file is no picture that can be decoded."""
    try:
        load_thumbnail(path, 64)
    except ValueError as error:
        raise ValueError(str(error).replace(str(path), name)) from None


def _check_video(path: Path, name: str) -> None:
    """Raise ValueError, which names the user's file `name`, if no frame of a video can be decoded."""
    video = cv2.VideoCapture(str(path))
    try:
        if not (video.isOpened() and video.read()[0]):
            raise ValueError(f"{name}: not a video that OpenCV reads; mp4, mov, mkv and webm are")
    finally:
        video.release()
