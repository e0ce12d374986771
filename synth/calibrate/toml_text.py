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
    head = "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    lines: list[str] = []
    _table(content, "", lines)
    return head + "\n".join(lines).strip("\n") + "\n"


def _table(table: dict[str, Any], path: str, lines: list[str]) -> None:
    """Plain values first: what follows a sub-table's header would belong to it."""
    plain = {key: value for key, value in table.items() if not _is_table(value) and not _is_list_of_tables(value)}
    for key, value in plain.items():
        lines.append(f"{_key(key)} = {_inline(value)}")
    for key, value in table.items():
        name = f"{path}.{_key(key)}" if path else _key(key)
        if _is_table(value):
            lines += ["", f"[{name}]"]
            _table(value, name, lines)
        elif _is_list_of_tables(value):
            for entry in value:
                lines += ["", f"[[{name}]]"]
                _table(entry, name, lines)


def _is_table(value: Any) -> bool:
    """A table that gets a header of its own; distributions and empty tables stay inline."""
    return isinstance(value, dict) and len(value) > 0 and not (len(value) == 1 and _is_short(value))


def _is_short(value: dict[str, Any]) -> bool:
    return all(isinstance(inner, list) for inner in value.values())


def _is_list_of_tables(value: Any) -> bool:
    return isinstance(value, list) and len(value) > 0 and all(_is_table(entry) for entry in value)


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else json.dumps(key)


def _inline(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(value)  # the shortest text that reads back as the same number
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_inline(inner) for inner in value) + "]"
    return "{ " + ", ".join(f"{_key(key)} = {_inline(inner)}" for key, inner in value.items()) + " }"
