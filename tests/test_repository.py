"""The repository is portable: its files include no symbolic links and no paths of a single machine."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
HOME = re.compile(r"(?<![\w./-])/(?:home|Users|root|work|mnt/c)/[\w.-]+/")  # an absolute folder of one machine


def tracked_files() -> list[tuple[str, Path]]:
    """Return the git mode and the path of each file tracked by git."""
    listed = subprocess.run(["git", "ls-files", "--stage", "-z"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("no git repository here")
    entries = (entry.split("\t", 1) for entry in listed.stdout.split("\0") if entry)
    return [(words.split()[0], ROOT / path) for words, path in entries]


def test_there_are_no_links():
    assert [path for mode, path in tracked_files() if mode == "120000"] == []


def test_no_file_names_a_folder_of_one_machine():
    text = [path for _, path in tracked_files() if path.suffix in (".py", ".md", ".yaml", ".toml", ".txt", ".html", "")]
    found = {
        f"{path.relative_to(ROOT)}: {match[0]}"
        for path in text
        if path.is_file() and path != Path(__file__)
        for match in HOME.finditer(path.read_text(encoding="utf-8", errors="ignore"))
    }
    assert found == set()
