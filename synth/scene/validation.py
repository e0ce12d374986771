"""Content that breaks the schema of a scene, told in one line a problem: where, what was given, what is allowed."""

import json
from collections.abc import Sequence
from difflib import get_close_matches
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from synth.errors import InputError
from synth.scene import Scene

Model = TypeVar("Model", bound=BaseModel)

DISTRIBUTIONS = ("uniform", "normal", "log_uniform", "choice")
_TAGS = ("kind", "shape")
"""Keys that tell the members of a union apart."""
_UNNAMED = ("box", "plane")
"""Shapes of tables that name none."""
_LONGEST = 80
"""Characters of a given value that are shown."""


def validated(content: Any, source: str, model: type[Model], at: str = "") -> Model:
    """Plain content as a part of a scene. Types are strict: true and "1" are not numbers, 2.0 is no whole number.

    The content is JSON-able; `source` is its file, for the messages; the model is Scene, or the part that stands at the
    key `at`. InputError has one line per problem with file, path, what was given and what is allowed.
    """
    try:
        return model.model_validate_json(json.dumps(content), strict=True)
    except ValidationError as error:
        whole = {at: content} if at else content
        # A list is also called too short where wrong entries of it were left out.
        told = [p for p in error.errors() if p["type"] != "too_short" or len(p["input"]) < p["ctx"]["min_length"]]
        lines: dict[str, str] = {}  # of a union, each member says what it allows
        for problem in told:
            place, must, allowed = _explain(problem, whole, at).partition(": must ")
            lines[place] = f"{lines[place]} or {allowed}" if place in lines else f"{place}{must}{allowed}"
        raise InputError("\n".join(f"{source}: {line}" for line in lines.values())) from error


def _explain(problem: ErrorDetails, content: Any, at: str) -> str:
    """One pydantic error as a line of our own."""
    location = (at, *problem["loc"]) if at else problem["loc"]
    where, given, context = _dotted(location, content), problem["input"], problem.get("ctx", {})
    match problem["type"]:
        case "extra_forbidden":
            key, (own, *others) = str(location[-1]), _members(location[:-1])
            if owners := [repr(tag) for other in others if key in other.model_fields for tag in _tags_of(other)]:
                return f"{where}: belongs to {' or '.join(owners)}, this is {_tags_of(own)[0]!r}"
            allowed = list(own.model_fields)
            close = get_close_matches(key, allowed, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"allowed here are {', '.join(allowed)}"
            return f"{where}: unknown key; {hint}"
        case "union_tag_invalid":
            tag = context["discriminator"].strip("'()")
            return f"{where}.{tag} = {given[tag]!r}: allowed are {context['expected_tags']}"
        case "union_tag_not_found":
            return f"{where}: lacks the key {context['discriminator'].strip(chr(39))!r}{_distribution_hint(given)}"
        case "missing":
            return f"{where}: is missing"
        case kind if isinstance(given, dict) and kind != "value_error":
            return f"{where}: {_said(problem)}, it is a table{_distribution_hint(given)}"
    shown = "" if isinstance(given, dict) else f" = {given!r}"
    shown = shown if len(shown) <= _LONGEST else f"{shown[:_LONGEST]}..."
    return f"{where}{shown}: {_said(problem)}" if where else _said(problem)


def _said(problem: ErrorDetails) -> str:
    """Pydantic's message in TOML's words."""
    message = problem["msg"].removeprefix("Value error, ")
    message = message.replace("Input should be", "must be").replace("Tuple should", "must")
    message = message.replace("an object", "a table").replace("valid array", "list").replace("item", "entry")
    if problem["type"] in ("int_type", "int_from_float"):
        message = "must be a whole number; to draw one, use { choice = [...] }"
    if problem["type"] == "string_pattern_mismatch":
        message = "must consist of letters A to Z, digits, _ and - alone"
    return message.replace(" after validation", "").replace("entrys", "entries")


def _distribution_hint(given: Any) -> str:
    """What to say of a table that may be a misspelt distribution."""
    if not isinstance(given, dict) or len(given) > 2:
        return ""
    close = [match for key in given for match in get_close_matches(key, DISTRIBUTIONS, n=1)]
    known = "a distribution is a table with one key: " + ", ".join(DISTRIBUTIONS)
    return f"; did you mean {close[0]!r}? ({known})" if close else ""


def _dotted(location: Sequence[int | str], content: Any) -> str:
    """Path as a user writes it, without the union tags that pydantic puts in it."""
    where, value = "", content
    for part in location:
        if isinstance(part, int):
            where += f"[{part}]"
            value = value[part] if isinstance(value, list) and part < len(value) else None
        elif where and _is_member(part, value):
            continue
        else:
            where += f".{part}" if where else part
            value = value.get(part) if isinstance(value, dict) else None
    return where


def _is_member(part: str, value: Any) -> bool:
    """Whether a part of pydantic's location names a member of the union that a value belongs to."""
    if not isinstance(value, dict):
        return True
    return part not in value and part in (*_UNNAMED, *(value.get(tag) for tag in _TAGS))


def _members(location: Sequence[int | str]) -> list[type[BaseModel]]:
    """The part of the schema at a location, before the other members of its union."""
    annotation: Any = Scene
    others: list[type[BaseModel]] = []
    for part in location:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            others = []
            annotation = annotation.model_fields[str(part)].annotation
        elif isinstance(part, int):
            annotation = get_args(annotation)[0]
        else:
            others = [getattr(member, "__origin__", member) for member in get_args(annotation)]
            annotation = next(member for member in others if part in _tags_of(member))
    return [annotation, *(other for other in others if other is not annotation)]


def _tags_of(member: type[BaseModel]) -> tuple[str, ...]:
    """Values of the key by which a union knows this member."""
    return next((get_args(member.model_fields[tag].annotation) for tag in _TAGS if tag in member.model_fields), ())
