"""Download of models from the Hugging Face Hub ("the hub"), for `make weights` alone.

Only this module imports huggingface_hub.
huggingface_hub downloads a file from its start again if the process was killed. So this module downloads large files
itself, into the library's cache, where the library finds them. It continues partial downloads, and checks each file's
sha256.
"""

from __future__ import annotations

import hashlib
import os
import urllib.request
from collections.abc import Sequence
from pathlib import Path

from reffusion.weights.published import NETWORKS, PUBLISHED, REVISIONS, TOKENIZERS

_OFFLINE_ADVICE = "run `make weights` on a machine with a network and copy its cache, or name a folder of weights"


def download_model(name: str, half: bool, only: Sequence[str] = ()) -> Path:
    """Download a model into the hub's cache on this machine, and return its folder in the cache.

    The revision is that of `REVISIONS`, else the one that an earlier download recorded (refs/main), else the newest.

    Args:
        name: hub id, owner/name.
        half: True to prefer weights in half precision.
        only: names of the only files to download; empty for all files that `select_files` chooses.

    Raises:
        ValueError: HF_HUB_OFFLINE is set, the hub does not answer, the model is unknown or gated, it has no
            .safetensors weights (or not all files `only`), or a file arrived damaged.
    """
    from huggingface_hub import HfApi, constants, hf_hub_url, snapshot_download
    from huggingface_hub import errors as hub
    from huggingface_hub.file_download import repo_folder_name

    known = PUBLISHED.get(name)
    remedy = f"take {known.instead}" if known else "take another model"
    if constants.HF_HUB_OFFLINE:
        raise ValueError(f"{name} is not here and HF_HUB_OFFLINE is set: unset it, or {_OFFLINE_ADVICE}")
    entry_folder = Path(constants.HF_HUB_CACHE, repo_folder_name(repo_id=name, repo_type="model"))
    main = entry_folder / "refs" / "main"  # the revision to load by default
    revision = REVISIONS.get(name) or (main.read_text().strip() if main.is_file() else None)
    try:
        info = HfApi().model_info(name, revision=revision, files_metadata=True)
        names = [entry.rfilename for entry in info.siblings]
        chosen = list(only) if only else select_files(names, half)
        absent = [each for each in only if each not in names]
        if absent or not chosen:
            missing = f"file {absent[0]}" if absent else ".safetensors weights, and others are not read"
            raise ValueError(f"{name} has no {missing}; {remedy}")
        for entry in info.siblings:
            if entry.lfs and entry.rfilename in chosen:
                url = hf_hub_url(name, entry.rfilename, revision=info.sha)
                _download_file(
                    url, entry_folder / "blobs" / entry.lfs.sha256, entry.lfs.sha256, entry.lfs.size, entry.rfilename
                )
        folder = Path(snapshot_download(name, revision=info.sha, allow_patterns=chosen))
        main.parent.mkdir(exist_ok=True)
        main.write_text(folder.name)  # the library does not write it when it downloads an exact revision
    except hub.GatedRepoError:
        raise ValueError(
            f"{name} is gated: accept its terms on its page of the hub and log in with `hf auth login`, or {remedy}"
        ) from None
    except hub.RepositoryNotFoundError:
        raise ValueError(
            f"{name}: the hub has no such model: misspelt, moved, deleted or private; correct the name, or {remedy}"
        ) from None
    except hub.RevisionNotFoundError:
        raise ValueError(f"{name}: the hub has no revision {revision} any more; {remedy}") from None
    except ValueError:
        raise
    except Exception as error:  # the library passes on errors of its HTTP library
        raise ValueError(f"{name}: the hub does not answer ({_one_line(error)}); {_OFFLINE_ADVICE}") from None
    return folder


def select_files(names: Sequence[str], half: bool) -> list[str]:
    """Select the files of a model that are needed: configurations, vocabularies, and one set of weights per part.

    Only .safetensors weights are selected. Checkpoints of a whole pipeline at the top level, other formats and safety
    checkers are left out.

    Args:
        names: names of all files of the model, with folders.
        half: True to select the weights marked fp16 if a part has them. The plain weights are selected otherwise,
            unless a part has only weights marked fp16.

    Returns:
        The names, or an empty list if the model has no .safetensors weights.
    """
    chosen: list[str] = []
    parts = {"": "", **{part + "/": part for part in (*NETWORKS, *TOKENIZERS, "scheduler")}}
    pipeline = "model_index.json" in names
    for start, part in parts.items():
        here = [name for name in names if name.startswith(start) and "/" not in name[len(start) :]]
        chosen += [n for n in here if n.endswith((".json", ".txt", ".model")) and ".index." not in n]
        weights = [n for n in here if ".safetensors" in n and "non_ema" not in n and (part or not pipeline)]
        marked = [n for n in weights if ".fp16" in n]
        plain = [n for n in weights if ".fp16" not in n]
        chosen += marked if marked and (half or not plain) else plain
    return chosen if any(".safetensors" in name for name in chosen) else []


def _download_file(url: str, target: Path, sha256: str, size: int, name: str) -> None:
    """Download a file to `target` unless it exists, continuing `target`.part; raises ValueError if the hash differs."""
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
            request.add_unredirected_header(header, value)  # a token is for the hub, not for servers it redirects to
        # This raises OSError if the server does not respond, or if the connection breaks.
        with urllib.request.urlopen(request, timeout=60) as response:
            done = done if response.status == 206 else 0  # status 200: the server sends the whole file again
            progress = tqdm(total=size, initial=done, unit="B", unit_scale=True, desc=name)
            with open(partial, "ab" if done else "wb") as out, progress:
                while block := response.read(1 << 20):
                    out.write(block)
                    progress.update(len(block))
    with open(partial, "rb") as content:
        digest = hashlib.file_digest(content, "sha256").hexdigest()
    if digest != sha256:
        partial.unlink()
        raise ValueError(f"{name} arrived damaged (sha256 {digest[:8]}, not {sha256[:8]}); fetch it again")
    os.replace(partial, target)


def _one_line(error: BaseException) -> str:
    """Return the message of an error, or its type without one, as one line of at most 120 characters."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 120 else text[:117] + "..."
