"""A scene's content as TOML text: the only shapes that scenes have, in the order in which they are read best."""

import json
import re
from typing import Any

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def toml_text(content: dict[str, Any], comment: str = "") -> str:
    """TOML of nested tables, lists of tables, numbers, texts and distributions.

    Args:
        content: JSON-able, without null.
        comment: lines to put in front.
    """
    lines = [f"# {line}".rstrip() for line in comment.splitlines()]
    _table(content, "", lines)
    return "\n".join(lines) + "\n"


def _table(table: dict[str, Any], path: str, lines: list[str]) -> None:
    """Plain values first: what follows a sub-table's header would belong to it."""
    headed = {}
    for key, value in table.items():
        if _is_table(value) or (isinstance(value, list) and value and all(map(_is_table, value))):
            headed[key] = value
        else:
            lines.append(f"{_key(key)} = {_inline(value)}")
    for key, value in headed.items():
        name = f"{path}.{_key(key)}" if path else _key(key)
        for entry in value if isinstance(value, list) else [value]:
            lines += ["", f"[[{name}]]" if isinstance(value, list) else f"[{name}]"]
            _table(entry, name, lines)


def _is_table(value: Any) -> bool:
    """A table that gets a header of its own; distributions and empty tables stay inline."""
    if not isinstance(value, dict) or not value:
        return False
    return len(value) > 1 or not isinstance(next(iter(value.values())), list)


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else json.dumps(key)


def _inline(value: Any) -> str:
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_inline(inner) for inner in value) + "]"
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(key)} = {_inline(inner)}" for key, inner in value.items()) + " }"
    if isinstance(value, float):
        return repr(value)  # the shortest text that reads back as the same number
    return json.dumps(value, ensure_ascii=False)
