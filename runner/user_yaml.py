"""Reading of YAML that people write, mainly scene.yaml.

Names of views stay text even if they look like numbers or dates. Size, depth and number of values are limited.
"""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import yaml

from runner import Refused

MAX_BYTES = 1_000_000  # largest size of a file
MAX_DEPTH = 20  # largest number of nested lists and mappings
MAX_VALUES = 10_000  # largest number of values; a value counts again for each alias that repeats it
TAGS = tuple(f"tag:yaml.org,2002:{kind}" for kind in ("str", "int", "float", "bool", "null", "seq", "map"))


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """A YAML loader that reads dates as text, because no value in these files is a date."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in those if not tag.endswith(":timestamp")]
    for first, those in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def read_user_yaml(path: Path, typed: tuple[str, ...]) -> dict[str, Any]:
    """Read a YAML file of `key: value` lines as a dict; empty if the file does not exist or is empty.

    YAML would read the names of views in `view: 20220819_104425` and `test: [2022-08-19, 007, on]` as numbers, dates
    and booleans. So scalars stay text as written, or None, except below the keys in `typed`. Lists and mappings are
    read as such everywhere, and keys are text.

    Args:
        path: the file.
        typed: the top-level keys below which scalars are read with YAML's types.

    Raises:
        Refused: the path is no regular file; the file is not text in UTF-8 or UTF-16, valid YAML or a mapping; a key
            occurs twice; a list of names has an empty entry; or a limit of this module is exceeded. The message names
            the file and, where known, the line.
    """
    if not path.is_file():
        if path.exists() or path.is_symlink():
            raise Refused(f"{path}: it must be a file")
        return {}
    try:
        if path.stat().st_size > MAX_BYTES:
            raise Refused(f"{path}: larger than {MAX_BYTES // 10**6} MB; a scene needs some lines")
        content = path.read_bytes()
        text = content.decode(json.detect_encoding(content))
    except (OSError, UnicodeDecodeError) as error:
        raise Refused(f"{path}: not readable text: {error}; save it as UTF-8") from None
    try:
        node, loader = _tree(text)
        if node is None or _is_null(node):
            return {}
        if not isinstance(node, yaml.MappingNode):
            raise Refused(f"{path}: expected `key: value` lines, found a {node.id}")
        return {key: _value(loader, value, key not in typed) for key, value in _pairs(loader, node)}
    except (yaml.YAMLError, ValueError) as error:
        if line := _line_with_tab(text, error):
            raise Refused(f"{path}: line {line}: a tab; YAML indents by blanks only") from None
        raise Refused(f"{path}: not valid YAML: {' '.join(str(error).split())}") from None


def parse_value(text: str, is_text: bool) -> Any:
    """Parse a value of the command line as YAML; None for an empty text.

    Args:
        text: the value.
        is_text: True keeps scalars as text, see `read_user_yaml`.

    Raises:
        ValueError: the text is not valid YAML, or a limit of this module is exceeded.
    """
    try:
        node, loader = _tree(text)
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from None
    return None if node is None else _value(loader, node, is_text)


def _line_with_tab(text: str, error: Exception) -> int | None:
    """Return the number of the line at which YAML failed if this line has a tab, else None."""
    mark, lines = getattr(error, "problem_mark", None), text.splitlines()
    return mark.line + 1 if mark and mark.line < len(lines) and "\t" in lines[mark.line] else None


def _tree(text: str) -> tuple[Any, Any]:
    """Parse YAML within the module's limits to (root node or None, loader); raises ValueError or yaml.YAMLError."""
    depth = 0
    for event in yaml.parse(text, _Loader):  # event by event, so that the depth is checked before nodes are built
        starts = isinstance(event, yaml.CollectionStartEvent)
        depth += starts - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH:
            raise ValueError(f"line {event.start_mark.line + 1}: more than {MAX_DEPTH} levels deep")
        tag = getattr(event, "tag", None)
        if tag not in (None, "!", *TAGS):
            raise ValueError(f"line {event.start_mark.line + 1}: the tag {tag!r:.60} is not understood; leave it out")
    loader = _Loader(text)
    node = loader.get_single_node()
    waiting, seen = [node] if node else [], 0
    while waiting:
        each, seen = waiting.pop(), seen + 1
        if seen > MAX_VALUES:
            raise ValueError(f"more than {MAX_VALUES} values, with those that aliases (*) repeat")
        if isinstance(each, yaml.CollectionNode):
            waiting += [part for item in each.value for part in (item if isinstance(item, tuple) else (item,))]
    return node, loader


def _pairs(loader: Any, node: yaml.MappingNode) -> list[tuple[str, Any]]:
    """Return (key as text, value node) pairs, also those merged by `<<`; raises ValueError for bad or repeated keys."""
    keys = Counter(_key(key) for key, _ in node.value)
    if twice := [key for key, count in keys.items() if count > 1]:
        raise ValueError(f"line {node.start_mark.line + 1}: the key {twice[0]!r:.60} comes twice; keep one")
    loader.flatten_mapping(node)
    return [(_key(key), value) for key, value in node.value]


def _key(node: Any) -> str:
    if not isinstance(node, yaml.ScalarNode):
        raise ValueError(f"line {node.start_mark.line + 1}: a key that is a list or a mapping")
    return node.value


def _is_null(node: Any) -> bool:
    return isinstance(node, yaml.ScalarNode) and node.tag == "tag:yaml.org,2002:null"


def _value(loader: Any, node: Any, is_text: bool) -> Any:
    """Construct a node's value; with `is_text` scalars stay text or None, and a null in a list raises ValueError."""
    if isinstance(node, yaml.SequenceNode):
        if is_text and (empty := [each for each in node.value if _is_null(each)]):
            what = (
                f"`{empty[0].value}` in a list means nothing; put it in quotes if it is a name"
                if empty[0].value
                else ("an empty entry in a list; name something, or remove it")
            )
            raise ValueError(f"line {empty[0].start_mark.line + 1}: {what}")
        return [_value(loader, each, is_text) for each in node.value]
    if isinstance(node, yaml.MappingNode):
        return {key: _value(loader, value, is_text) for key, value in _pairs(loader, node)}
    return None if _is_null(node) else node.value if is_text else loader.construct_object(node)
