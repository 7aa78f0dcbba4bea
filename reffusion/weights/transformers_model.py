"""Models of the library transformers, from folders on this machine."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import torch


def load_model(folder: Path, kind: str, class_name: str) -> Any:
    """Return the model in a folder, in float32.

    Args:
        folder: a model folder of transformers.
        kind: the `model_type` that its configuration must have.
        class_name: name of the class of transformers that loads it.

    Raises:
        ValueError: the folder holds no model, an incomplete one, or one of another kind. The message has one line and
            begins with the folder.
    """
    import transformers
    from transformers.utils import logging as transformers_logging

    if not (folder / "config.json").is_file():
        raise ValueError(f"{folder} lacks config.json; it must be a transformers model folder")
    transformers_logging.disable_progress_bar()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = transformers.AutoConfig.from_pretrained(folder).model_type
            if found != kind:
                raise ValueError(f"a model of type {found!r}; those of type {kind!r} are understood")
            return getattr(transformers, class_name).from_pretrained(folder, dtype=torch.float32)
    except (OSError, ValueError) as error:
        raise ValueError(f"{folder}: {str(error).splitlines()[0]}") from error
