"""Fetching models of the hub. The only importer of huggingface_hub.

Its library begins a file anew where a process was killed. So large files are fetched here, into its cache, where it
finds them.

Called by `make weights` alone. Half-fetched files are gone on with; what has arrived is checked by its sha256.
"""

from __future__ import annotations

import hashlib
import os
import urllib.request
from collections.abc import Sequence
from pathlib import Path

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
    from huggingface_hub import HfApi, constants, hf_hub_url, snapshot_download
    from huggingface_hub import errors as hub
    from huggingface_hub.file_download import repo_folder_name

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
        blobs = Path(constants.HF_HUB_CACHE, repo_folder_name(repo_id=name, repo_type="model"), "blobs")
        for entry in facts.siblings:
            if entry.lfs and entry.rfilename in chosen:
                url = hf_hub_url(name, entry.rfilename, revision=facts.sha)
                _fetch(url, blobs / entry.lfs.sha256, entry.lfs.sha256, entry.lfs.size, entry.rfilename)
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


def _fetch(url: str, target: Path, sha256: str, size: int, name: str) -> None:
    """A file to `target`, unless it is there; what an earlier try left in `target`.part is gone on with.

    Raises:
        ValueError: other content than expected, which is then removed.
        OSError: no answer, or it breaks off.
    """
    from huggingface_hub.utils import build_hf_headers
    from tqdm import tqdm

    if target.exists():
        return
    partial = target.with_name(target.name + ".part")
    partial.parent.mkdir(parents=True, exist_ok=True)
    done = partial.stat().st_size if partial.exists() else 0
    if done < size:
        request = urllib.request.Request(url, headers={"Range": f"bytes={done}-"} if done else {})
        for header, value in build_hf_headers().items():
            request.add_unredirected_header(header, value)  # a token is for the hub, not for where it sends us
        with urllib.request.urlopen(request, timeout=60) as answer:
            done = done if answer.status == 206 else 0  # 200: the whole file
            bar = tqdm(total=size, initial=done, unit="B", unit_scale=True, desc=name)
            with open(partial, "ab" if done else "wb") as out, bar:
                while block := answer.read(1 << 20):
                    out.write(block)
                    bar.update(len(block))
    with open(partial, "rb") as content:
        found = hashlib.file_digest(content, "sha256").hexdigest()
    if found != sha256:
        partial.unlink()
        raise ValueError(f"{name} arrived damaged (sha256 {found[:8]}, not {sha256[:8]}); fetch it again")
    os.replace(partial, target)


def _line(error: BaseException) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 120 else text[:117] + "..."
