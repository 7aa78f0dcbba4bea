"""Fetching weights: models of the hub, and plain files. The only importer of huggingface_hub.

Called by `make weights` alone. Half-fetched files are gone on with; what has arrived is checked by its sha256.
"""

from __future__ import annotations

import hashlib
import os
import urllib.error
import urllib.request
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from reffusion.weights.published import NETWORKS, PUBLISHED

_ELSEWHERE = "run `make weights` on a machine with a network and copy its cache, or name a folder of weights"


def model(name: str, half: bool, only: str | None = None) -> Path:
    """A hub model into the hub's own cache; its folder there.

    Args:
        name: owner/name.
        half: take the half-precision files where the model has them.
        only: this file of it, and nothing else.
    Raises:
        ValueError: offline, no network, no such model, not open to all, no .safetensors weights, or a damaged file.
    """
    from huggingface_hub import HfApi, constants, snapshot_download
    from huggingface_hub import errors as hub

    known = PUBLISHED.get(name)
    instead = f"take {known.instead}" if known else "take another model"
    if constants.HF_HUB_OFFLINE:
        raise ValueError(f"{name} is not here and HF_HUB_OFFLINE is set: unset it, or {_ELSEWHERE}")
    try:
        facts = HfApi().model_info(name, files_metadata=True)
        names = [entry.rfilename for entry in facts.siblings]
        chosen = [each for each in names if each == only] if only else chosen_files(names, half)
        if not chosen:
            what = f"file {only}" if only else ".safetensors weights, and others are not read"
            raise ValueError(f"{name} has no {what}; {instead}")
        folder = Path(snapshot_download(name, revision=facts.sha, allow_patterns=chosen))
        _mark_main(folder)
    except hub.GatedRepoError:
        raise ValueError(
            f"{name} is gated: accept its terms on its page of the hub and log in with `hf auth login`, or {instead}"
        ) from None
    except hub.RepositoryNotFoundError:
        raise ValueError(
            f"{name}: the hub has no such model: misspelt, moved, deleted or private; correct the name, or {instead}"
        ) from None
    except ValueError:
        raise
    except Exception as error:  # the hub's library passes on what its HTTP library raises
        raise ValueError(f"{name}: the hub does not answer ({_line(error)}); {_ELSEWHERE}") from None
    for entry in facts.siblings:
        if entry.lfs and entry.rfilename in chosen:
            _check(folder / entry.rfilename, entry.lfs.sha256)
    return folder


def chosen_files(names: Sequence[str], half: bool) -> list[str]:
    """What of a model's files is needed: configurations, vocabularies, one set of weights a part.

    Weights are .safetensors: those marked fp16 where `half` and a part has them, else the plain ones. A checkpoint
    of the whole pipeline at the top, other formats and a safety checker stay where they are.
    """
    chosen: list[str] = []
    parts = {"": "", **{part + "/": part for part in (*NETWORKS, "tokenizer", "tokenizer_2", "scheduler")}}
    pipeline = "model_index.json" in names
    for start, part in parts.items():
        here = [name for name in names if name.startswith(start) and "/" not in name[len(start) :]]
        chosen += [n for n in here if n.endswith((".json", ".txt", ".model")) and ".index." not in n]
        weights = [n for n in here if ".safetensors" in n and "non_ema" not in n and (part or not pipeline)]
        marked = [n for n in weights if ".fp16" in n]
        plain = [n for n in weights if ".fp16" not in n]
        chosen += marked if marked and (half or not plain) else plain
    return chosen if any(".safetensors" in name for name in chosen) else []


def _mark_main(folder: Path) -> None:
    """A download by its exact state leaves no refs/main, by which it is found again."""
    refs = folder.parent.parent / "refs"
    refs.mkdir(exist_ok=True)
    (refs / "main").write_text(folder.name)


def file(url: str, target: Path, sha256: str, size: int | None) -> None:
    """A plain file to `target`; what an earlier try left in `target`.part is gone on with.

    Args:
        sha256: of the whole file, or how it begins.
        size: bytes, for the progress bar.
    Raises:
        ValueError: offline, no network, moved, or other content than expected (which is then removed).
    """
    from tqdm import tqdm

    if os.environ.get("HF_HUB_OFFLINE", "").upper() in ("1", "ON", "YES", "TRUE"):
        raise ValueError(f"{target.name} is not here and HF_HUB_OFFLINE is set: unset it, or put the file there")
    partial = target.with_name(target.name + ".part")
    partial.parent.mkdir(parents=True, exist_ok=True)
    done = partial.stat().st_size if partial.exists() else 0
    try:
        with _opened(url, done) as answer:
            if answer.status != 206:  # the whole file: the server does not go on
                done = 0
            with (
                open(partial, "ab" if done else "wb") as out,
                tqdm(total=size, initial=done, unit="B", unit_scale=True, desc=target.name) as bar,
            ):
                while block := answer.read(1 << 20):
                    out.write(block)
                    bar.update(len(block))
    except urllib.error.HTTPError as error:
        if error.code != 416:  # 416: nothing is left to fetch
            raise ValueError(f"{url}: {error.code} {error.reason}: moved? Put the file at {target}") from None
    except OSError as error:
        raise ValueError(f"{url} does not answer ({_line(error)}); put the file at {target}, or try again") from None
    _check(partial, sha256)
    os.replace(partial, target)


def _opened(url: str, done: int) -> Any:
    headers = {"User-Agent": "reffusion", **({"Range": f"bytes={done}-"} if done else {})}
    return urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=60)


def _check(path: Path, sha256: str) -> None:
    with open(path, "rb") as content:
        found = hashlib.file_digest(content, "sha256").hexdigest()
    if not found.startswith(sha256):
        path.resolve().unlink()
        path.unlink(missing_ok=True)
        raise ValueError(f"{path.name} arrived damaged (sha256 {found[:8]}, not {sha256[:8]}); fetch it again")


def _line(error: BaseException) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 120 else text[:117] + "..."
