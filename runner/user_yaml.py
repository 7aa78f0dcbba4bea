"""YAML that people write by hand, scene.yaml above all: names are text, and nothing in it can cost much."""

from collections import Counter
from pathlib import Path
from typing import Any

import yaml

from runner import Refused

LONGEST = 1_000_000  # bytes of a file
DEEPEST = 20  # lists and mappings inside each other
MOST = 10_000  # values, those that aliases repeat included
TAGS = tuple(f"tag:yaml.org,2002:{kind}" for kind in ("str", "int", "float", "bool", "null", "seq", "map"))


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Without dates, which nothing here is."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in those if not tag.endswith(":timestamp")]
    for first, those in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def read_handed(path: Path, typed: tuple[str, ...]) -> dict[str, Any]:
    """The `key: value` lines of a file. What stands under keys other than `typed` is text as it is written, or None:
    `view: 20220819_104425` and `test: [2022-08-19, 007, on]` name views, and YAML would make numbers and dates of them.

    Raises:
        Refused: naming the file and, where there is one, the line: it is no regular file, no text in UTF-8, no YAML, or
            no mapping; a key comes twice; it is larger, deeper or more repetitive than any scene needs.
    """
    if not path.is_file():
        if path.exists() or path.is_symlink():
            raise Refused(f"{path}: it must be a file")
        return {}
    try:
        if path.stat().st_size > LONGEST:
            raise Refused(f"{path}: larger than {LONGEST // 10**6} MB; a scene needs some lines")
        node, loader = _tree(path.read_bytes().decode("utf-8-sig"))
        if node is None or _is_null(node):
            return {}
        if not isinstance(node, yaml.MappingNode):
            raise Refused(f"{path}: expected `key: value` lines, found a {node.id}")
        return {key: _value(loader, value, key not in typed) for key, value in _pairs(loader, node)}
    except (yaml.YAMLError, ValueError, OSError) as error:
        raise Refused(f"{path}: not valid YAML: {' '.join(str(error).split())}") from None


def value_of(text: str, is_text: bool) -> Any:
    """A value that was typed; `is_text` as in `read_handed`. Raises ValueError where it is not valid YAML."""
    try:
        node, loader = _tree(text)
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from None
    return None if node is None else _value(loader, node, is_text)


def _tree(text: str) -> tuple[Any, Any]:
    """The document as nodes, checked, and their loader."""
    depth = 0
    for event in yaml.parse(text, _Loader):  # in steps: nothing is built before its depth is known
        starts = isinstance(event, yaml.CollectionStartEvent)
        depth += starts - isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST:
            raise ValueError(f"line {event.start_mark.line + 1}: more than {DEEPEST} levels deep")
        tag = getattr(event, "tag", None)
        if tag not in (None, "!", *TAGS):
            raise ValueError(f"line {event.start_mark.line + 1}: the tag {tag!r:.60} is not understood; leave it out")
    loader = _Loader(text)
    node = loader.get_single_node()
    waiting, seen = [node] if node else [], 0
    while waiting:
        each, seen = waiting.pop(), seen + 1
        if seen > MOST:
            raise ValueError(f"more than {MOST} values, with those that aliases (*) repeat")
        if isinstance(each, yaml.CollectionNode):
            waiting += [part for item in each.value for part in (item if isinstance(item, tuple) else (item,))]
    return node, loader


def _pairs(loader: Any, node: yaml.MappingNode) -> list[tuple[str, Any]]:
    """Keys, as text, and values of a mapping; what it merges by `<<` included."""
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
