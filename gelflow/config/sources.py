"""A training configuration from a preset or TOML file and assignments, the later ones winning.

Presets are TOML files in `gelflow/presets`; the comment at the head of each says what it is and where it comes from.
"""

import tomllib
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from gelflow.config import REGISTRATIONS, TrainConfig
from gelflow.config.validation import validated
from gelflow.errors import InputError
from gelflow.untrusted import DEEPEST, MOST_TEXT, assigned_value, parsed, read_file

PRESETS = ("best", "real", "bare", "paper", "selfflow", "arflow")
"""Names of the configurations that come with the package."""


def train_config(
    path: Path | str | None = None,
    assignments: Sequence[str] = (),
    start: Mapping[str, Any] | None = None,
) -> TrainConfig:
    """Puts a configuration together and validates it once.

    The path is a preset's name, or a TOML file with the fields of `TrainConfig`; tables [model] and [loss]. Assignments
    are `key=value`, key with dots (`loss.lambda_dc=10`), value in TOML; a value that is no TOML is text. The fields of
    `start` stand before the file is read. A preset's warm-up is shortened where the run would end in it. InputError
    where the file cannot be read, an assignment is malformed, or a field does not exist or is out of range.
    """
    values: dict[str, Any] = {name: dict(v) if isinstance(v, Mapping) else v for name, v in (start or {}).items()}
    if path is not None:
        _merge(values, _read(path))
        _spell_out(values)
    for assignment in assignments:
        _assign(values, assignment)
        _spell_out(values)
    steps, stated = values.get("steps"), any(text.partition("=")[0].strip() == "warmup_steps" for text in assignments)
    if str(path) in PRESETS and isinstance(steps, int | float) and not stated:
        values["warmup_steps"] = max(0, min(values.get("warmup_steps", 0), int(steps) - 1))
    sources = filter(None, (str(path or "default configuration"), ", ".join(assignments)))
    return validated(TrainConfig, values, " with ".join(sources))


def _read(path: Path | str) -> dict[str, Any]:
    place = Path(str(files("gelflow"))) / "presets" / f"{path}.toml" if str(path) in PRESETS else Path(path)
    try:
        return dict(parsed(tomllib.loads, read_file(place, MOST_TEXT).decode(), str(path)))
    except FileNotFoundError as error:
        raise InputError(
            f"{path}: neither a configuration file nor a preset; presets are {', '.join(PRESETS)}"
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as a TOML configuration: {error}") from error


def _merge(values: dict[str, Any], new: Mapping[str, Any]) -> None:
    for name, value in new.items():
        if isinstance(value, dict) and isinstance(values.get(name), dict):
            _merge(values[name], value)
        else:
            values[name] = value


def _spell_out(values: dict[str, Any]) -> None:
    """Puts what a registration's name stands for in its place, so that what follows can change single fields of it."""
    model = values.get("model")
    if not isinstance(model, dict) or not isinstance(name := model.get("registration"), str):
        return
    if name not in REGISTRATIONS:
        raise InputError(f"model.registration: {name!r} is no registration; names are {', '.join(REGISTRATIONS)}")
    meant = REGISTRATIONS[name]
    model["registration"] = None if meant is None else meant.model_dump()


def _assign(values: dict[str, Any], assignment: str) -> None:
    key, equals, text = assignment.partition("=")
    names = key.strip().split(".")
    if not equals or not all(names) or len(names) > DEEPEST or len(assignment.splitlines()) > 1:
        raise InputError(f"--set {assignment!r}: KEY=VALUE is needed, such as loss.lambda_dc=10, in one line")
    value = assigned_value(text, f"--set {key}")
    table = values
    for name in names[:-1]:
        if table.get(name) is None:  # what is switched off, such as model.registration, is switched on by its fields
            table[name] = {}
        table = table[name]
        if not isinstance(table, dict):
            raise InputError(f"--set {assignment}: {name} is a value, not a table")
    table[names[-1]] = value
