"""Reads YAML that people write, above all scene.yaml: keeps names as text, and bounds size, depth and aliases."""

from collections import Counter
from pathlib import Path
from typing import Any

import yaml

from runner import Refused

MAX_BYTES = 1_000_000  # size of a file
MAX_DEPTH = 20  # nested lists and mappings
MAX_VALUES = 10_000  # values, with those that aliases repeat
TAGS = tuple(f"tag:yaml.org,2002:{kind}" for kind in ("str", "int", "float", "bool", "null", "seq", "map"))


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Reads no dates: nothing in these files is one."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in those if not tag.endswith(":timestamp")]
    for first, those in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def read_user_yaml(path: Path, typed: tuple[str, ...]) -> dict[str, Any]:
    """The `key: value` lines of a file. Values of keys outside `typed` stay text as written, or None: in
    `view: 20220819_104425` and `test: [2022-08-19, 007, on]` YAML would read names of views as numbers and dates.

    Raises:
        Refused: it is not a regular file, UTF-8 text, YAML or a mapping; a key comes twice; it exceeds a limit of this
            module. The message names the file and, where known, the line.
    """
    if not path.is_file():
        if path.exists() or path.is_symlink():
            raise Refused(f"{path}: it must be a file")
        return {}
    try:
        if path.stat().st_size > MAX_BYTES:
            raise Refused(f"{path}: larger than {MAX_BYTES // 10**6} MB; a scene needs some lines")
        node, loader = _tree(path.read_bytes().decode("utf-8-sig"))
        if node is None or _is_null(node):
            return {}
        if not isinstance(node, yaml.MappingNode):
            raise Refused(f"{path}: expected `key: value` lines, found a {node.id}")
        return {key: _value(loader, value, key not in typed) for key, value in _pairs(loader, node)}
    except (yaml.YAMLError, ValueError, OSError) as error:
        raise Refused(f"{path}: not valid YAML: {' '.join(str(error).split())}") from None


def parse_value(text: str, is_text: bool) -> Any:
    """Parse a value of the command line; `is_text` keeps it as text, see `read_user_yaml`.

    Raises:
        ValueError: it is not valid YAML.
    """
    try:
        node, loader = _tree(text)
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from None
    return None if node is None else _value(loader, node, is_text)


def _tree(text: str) -> tuple[Any, Any]:
    """The checked nodes of a document, and their loader."""
    depth = 0
    for event in yaml.parse(text, _Loader):  # event by event: checks the depth before nodes are built
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
    """Keys, as text, and values of a mapping, with those that it merges by `<<`."""
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
    if isinstance(node, yaml.SequenceNode):
        return [_value(loader, each, is_text) for each in node.value]
    if isinstance(node, yaml.MappingNode):
        return {key: _value(loader, value, is_text) for key, value in _pairs(loader, node)}
    return None if _is_null(node) else node.value if is_text else loader.construct_object(node)
