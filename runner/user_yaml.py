"""Reading of YAML that people write, mainly scene.yaml.

Names of views stay text even if they look like numbers or dates. Size and depth are limited. Tags are refused, and so
are aliases, since few lines with them can mean billions of values.
"""

import json
from pathlib import Path
from typing import Any

import yaml
from yaml.constructor import SafeConstructor

from runner import Refused

MAX_BYTES = 1_000_000  # largest size of a file
MAX_DEPTH = 20  # largest number of nested lists and mappings
NULL = "tag:yaml.org,2002:null"


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """A YAML loader for which scalars are numbers, booleans, null or text: dates and `<<` are text."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in those if tag.endswith((":int", ":float", ":bool", ":null"))]
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
        node = _parse(text)
        if node is None or _is_null(node):
            return {}
        if not isinstance(node, yaml.MappingNode):
            raise ValueError(f"expected `key: value` lines, found a {node.id}")
        return {key: _value(value, key not in typed) for key, value in _pairs(node).items()}
    except ValueError as error:
        raise Refused(f"{path}: {error}") from None


def parse_value(text: str, is_text: bool) -> Any:
    """Parse a value of the command line as YAML; None for an empty text.

    Args:
        text: the value.
        is_text: True keeps scalars as text, see `read_user_yaml`.

    Raises:
        ValueError: the text is not valid YAML, or a limit of this module is exceeded.
    """
    node = _parse(text)
    return None if node is None else _value(node, is_text)


def _parse(text: str) -> Any:
    """Parse YAML to its root node, or None for an empty text; raises ValueError, also beyond the module's limits."""
    depth = 0
    try:
        for event in yaml.parse(text, _Loader):  # event by event, so that the depth is checked before nodes are built
            line = f"line {event.start_mark.line + 1}"
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > MAX_DEPTH:
                raise ValueError(f"{line}: more than {MAX_DEPTH} levels deep")
            if isinstance(event, yaml.AliasEvent):
                raise ValueError(f"{line}: the alias *{event.anchor:.60} is not understood; write the value itself")
            if (tag := getattr(event, "tag", None)) not in (None, "!"):
                raise ValueError(f"{line}: the tag {tag!r:.60} is not understood; leave it out")
        return yaml.compose(text, _Loader)
    except yaml.YAMLError as error:
        mark, lines = getattr(error, "problem_mark", None), text.splitlines()
        if mark and mark.line < len(lines) and "\t" in lines[mark.line]:
            raise ValueError(f"line {mark.line + 1}: a tab; YAML indents by blanks only") from None
        raise ValueError(f"not valid YAML: {' '.join(str(error).split())}") from None


def _pairs(node: yaml.MappingNode) -> dict[str, yaml.Node]:
    """Return key -> node of its value; raises ValueError for a key that is no text or comes twice."""
    found: dict[str, yaml.Node] = {}
    for key, value in node.value:
        line = f"line {key.start_mark.line + 1}"
        if not isinstance(key, yaml.ScalarNode):
            raise ValueError(f"{line}: a key that is a list or a mapping")
        if key.value in found:
            raise ValueError(f"{line}: the key {key.value!r:.60} comes twice; keep one")
        found[key.value] = value
    return found


def _is_null(node: yaml.Node) -> bool:
    """Return whether a node is a null of YAML, such as `null`, `~` or nothing."""
    return isinstance(node, yaml.ScalarNode) and node.tag == NULL


def _value(node: yaml.Node, is_text: bool) -> Any:
    """Construct a node's value; with `is_text` scalars stay text or None, and a null in a list raises ValueError."""
    if isinstance(node, yaml.SequenceNode):
        for empty in filter(_is_null, node.value if is_text else ()):
            what = "an empty entry in a list; name something, or remove it"
            if empty.value:
                what = f"`{empty.value}` in a list means nothing; put it in quotes if it is a name"
            raise ValueError(f"line {empty.start_mark.line + 1}: {what}")
        return [_value(each, is_text) for each in node.value]
    if isinstance(node, yaml.MappingNode):
        return {key: _value(value, is_text) for key, value in _pairs(node).items()}
    if _is_null(node):
        return None
    return node.value if is_text else SafeConstructor().construct_object(node)
