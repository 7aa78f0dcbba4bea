"""Photographs for the training of the embedded prior: `python -m lab.prior.photographs OUT`.

Four packages of Debian 12 hold them. The command downloads the packages, checks them, and writes each photograph at
reduced size. The folder is 11 MB; training on another machine needs nothing else.
"""

from __future__ import annotations

import argparse
import hashlib
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import cv2
import numpy as np

LONGEST_SIDE = 1600  # px, of a reduced photograph
QUALITY = 92  # of JPEG
HELD_OUT_EVERY = 6  # every sixth photograph, by name, is held out

PACKAGES = {  # package=version -> SHA-256 of the downloaded file
    "lomiri-wallpapers-16.04=20.04.0-2": "a99ff6a3bfe451e4cc0682ecb3cc82e71740626d59e4845ae34a0a0e45421eab",
    "lomiri-wallpapers-20.04=20.04.0-2": "d44e89b8473aafe64a5b678f014862dc31335aaaf18665c544d985d854f1a709",
    "mate-backgrounds=1.26.0-1": "7bf4c2209f34b4f61ba6d24c8b58c28b361e82e4b943aae6d42c030169af9e04",
    "plasma-workspace-wallpapers=4:5.27.5-2": "32cd18b71c8c938a18b3b351f217c02ac590e323caa3cf322fbb875ce8892f8b",
}


class Photograph(NamedTuple):
    """A photograph in a package, with what the package states about it.

    Attributes:
        file: path below /usr/share/backgrounds or /usr/share/wallpapers.
        author, licence: as stated in the package's copyright file or in the photograph's metadata.
        subject: what captions name, in the words of `build.WORDS`.
    """

    file: str
    author: str
    licence: str
    subject: str


PHOTOGRAPHS = (
    Photograph("Bridge_by_Sander_Klootwijk.jpg", "Sander Klootwijk", "CC BY-SA 4.0", "sky"),
    Photograph("Dragonfly_by_Bolly.jpg", "Bolly", "CC BY-SA 4.0", "leaves"),
    Photograph("Picture_0B_by_freespace.jpg", "Trevor 'Freespace'", "CC BY 4.0", "things"),
    Photograph("Picture_1A_by_freespace.jpg", "Trevor 'Freespace'", "CC BY 4.0", "things"),
    Photograph("Wine_by_Jakkub_Mede.jpg", "Jakub Mede", "CC BY 4.0", "a room"),
    Photograph("aitzgorri_by_Aitzol_Berasategi.jpg", "Aitzol Berasategi", "CC BY 4.0", "hills"),
    Photograph("free_by_Peter_Nerlich.jpg", "Peter Nerlich", "CC BY-SA 4.0", "a room"),
    Photograph("friends_by_Aitzol_Berasategi.jpg", "Aitzol Berasategi", "CC BY 4.0", "wood"),
    Photograph("greentock_by_Peter_Nerlich.jpg", "Peter Nerlich", "CC BY-SA 4.0", "things"),
    Photograph("life_by_Aitzol_Berasategi.jpg", "Aitzol Berasategi", "CC BY 4.0", "a forest"),
    Photograph("picosdeeuropa_by_Aitzol_Berasategi.jpg", "Aitzol Berasategi", "CC BY 4.0", "hills"),
    Photograph("seeding_by_Clements_Engelhardt.jpg", "Clemens Engelhardt", "CC0 1.0", "flowers"),
    Photograph("sunset_by_Aitzol_Berasategi.jpg", "Aitzol Berasategi", "CC BY 4.0", "hills"),
    Photograph("Kleiber_by_Lukas_Baubkus.jpg", "Lukas Baubkus", "CC BY-SA 3.0", "wood"),
    Photograph("mate/nature/Aqua.jpg", "Charles Barbin", "GPL 2+", "water"),
    Photograph("mate/nature/Blinds.jpg", "Lennart Poettering, Andrea Cimitan", "GPL 2+", "leaves"),
    Photograph("mate/nature/Dune.jpg", "Marco Cogoni, Hylke Bons", "GPL 2+", "grass"),
    Photograph("mate/nature/FreshFlower.jpg", "Jens Ansorg", "GPL 2+", "flowers"),
    Photograph("mate/nature/Garden.jpg", "Charles Barbin", "GPL 2+", "flowers"),
    Photograph("mate/nature/GreenMeadow.jpg", "Timothy Schellhase, Lapo Calamandrei", "GPL 2+", "grass"),
    Photograph("mate/nature/LadyBird.jpg", "Charles Barbin", "GPL 2+", "flowers"),
    Photograph("mate/nature/RainDrops.jpg", "blackcombwhistler07", "GPL 2+", "leaves"),
    Photograph("mate/nature/Storm.jpg", "Sergey Nazarov", "GPL 2+", "sky"),
    Photograph("mate/nature/TwoWings.jpg", "Charles Barbin, Hylke Bons", "GPL 2+", "flowers"),
    Photograph("mate/nature/Wood.jpg", "Jean-François Fortin Tam", "GPL 2+", "wood"),
    Photograph("mate/nature/YellowFlower.jpg", "Charles Barbin", "GPL 2+", "flowers"),
    Photograph("BytheWater/contents/images/2560x1600.jpg", "Maciej Wiklo", "LGPL 3", "water"),
    Photograph("ColdRipple/contents/images/2560x1600.jpg", "Risto Saukonpää", "LGPL 3", "water"),
    Photograph("ColorfulCups/contents/images/2560x1600.jpg", "Dmitri Popov", "LGPL 3", "things"),
    Photograph("DarkestHour/contents/images/2560x1600.jpg", "Risto Saukonpää", "LGPL 3", "sky"),
    Photograph("EveningGlow/contents/images/2560x1600.jpg", "Ian Hex", "LGPL 3", "water"),
    Photograph("FallenLeaf/contents/images/2560x1600.jpg", "Martin Klapetek", "LGPL 3", "leaves"),
    Photograph("Kite/contents/images/2560x1600.jpg", "Risto Saukonpää", "LGPL 3", "sky"),
    Photograph("OneStandsOut/contents/images/2560x1600.jpg", "Risto Saukonpää", "LGPL 3", "leaves"),
    Photograph("Path/contents/images/2560x1600.jpg", "Risto Saukonpää", "LGPL 3", "a forest"),
    Photograph("summer_1am/contents/images/2560x1600.jpg", "Risto Saukonpää", "LGPL 3", "sky"),
)


def short_name(photograph: Photograph) -> str:
    """Return a name for the reduced photograph: its own, or that of the folder if the file is named by its size."""
    path = Path(photograph.file)
    return path.parts[0] if "contents" in path.parts else path.stem.split("_by_")[0]


def load_photographs(folder: Path, held_out: bool) -> list[tuple[str, np.ndarray]]:
    """Load the reduced photographs.

    Args:
        folder: the output of this module.
        held_out: load those that training never sees, instead of those that it sees.

    Returns:
        The subjects, and the photographs as uint8 [H, W, 3]; sorted by name.

    Raises:
        ValueError: the folder lacks a photograph.
    """
    subjects = dict(sorted((short_name(each), each.subject) for each in PHOTOGRAPHS))
    chosen = [name for index, name in enumerate(subjects) if (index % HELD_OUT_EVERY == 0) == held_out]
    missing = [name for name in chosen if not (folder / f"{name}.jpg").is_file()]
    if missing:
        raise ValueError(f"{folder}: {', '.join(missing)} missing; run python -m lab.prior.photographs {folder}")
    load = lambda name: cv2.imread(str(folder / f"{name}.jpg"), cv2.IMREAD_COLOR)[..., ::-1].copy()
    return [(subjects[name], load(name)) for name in chosen]


def collect_photographs(folder: Path) -> None:
    """Download the packages and write the reduced photographs.

    Raises:
        ValueError: the machine has no apt or dpkg, a package cannot be had, or it is not the recorded one.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as name:
        work = Path(name)
        for package, digest in PACKAGES.items():
            _unpack(package, digest, work)
        for each in PHOTOGRAPHS:
            (source,) = work.glob(f"usr/share/*/{each.file}")
            picture = cv2.imread(str(source), cv2.IMREAD_COLOR)
            scale = LONGEST_SIDE / max(picture.shape[:2])
            small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(folder / f"{short_name(each)}.jpg"), small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


def _unpack(package: str, digest: str, folder: Path) -> None:
    """Download a package by apt, check it, and unpack it into a folder."""
    run = lambda *command: subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
    try:
        run("apt-get", "download", package)
        (file,) = folder.glob("*.deb")
        if hashlib.sha256(file.read_bytes()).hexdigest() != digest:
            raise ValueError(f"{package}: this is not the recorded package; its SHA-256 differs")
        run("dpkg-deb", "--extract", file.name, ".")
        file.unlink()
    except FileNotFoundError as error:
        raise ValueError(f"{error.filename} is missing; collect the photographs on Debian or Ubuntu") from error
    except subprocess.CalledProcessError as error:
        raise ValueError(f"{package}: {error.stderr.strip().splitlines()[-1]}") from error


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder for the reduced photographs")
    try:
        collect_photographs(parser.parse_args().out)
    except ValueError as error:
        sys.exit(f"error: {error}")
