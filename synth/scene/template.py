"""A scene file: TOML in which any number may be a distribution.

    { uniform = [a, b] }   { normal = [mean, sd] }   { log_uniform = [a, b] }   { choice = [...] }

`choice` may hold whole tables (indenters, say) with distributions inside. A `file` with wildcards, "objects/*.stl", is
a choice of the files that match. `extends = "gelsight_mini"` takes the rest from another scene.

A scene is checked when it is loaded: at the lower and upper end of all its distributions and for every choice, so that
a mistake shows before any work is done. A `normal` is checked at its mean: a number from its tails that breaks the
schema is drawn again (`synth.sampling`).
"""

import hashlib
import json
import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cached_property, partial
from importlib.resources import files
from pathlib import Path
from typing import Any

from synth.errors import InputError
from synth.scene import Numerics, Outputs, Sampling, Scene
from synth.scene.gel_file import measured
from synth.scene.pose_file import with_poses
from synth.scene.validation import DISTRIBUTIONS, validated
from synth.untrusted import DEEPEST, MOST_FOLDERS, assigned_value, matching_files, open_file, read_toml

_INSTALLED = Path(str(files("synth"))).resolve() / "scenes"
SCENES = _INSTALLED if _INSTALLED.is_dir() else _INSTALLED.parents[1] / "scenes"
"""The shipped scene files: in the package where it is installed, beside it in a checkout."""
FIXED = ("name", "description", "references", "numerics", "outputs", "sampling")
"""Parts that all samples of a dataset share."""
MOST_OPTIONS = 10_000
"""Of all choices of a scene: each is checked when the scene is loaded."""
FILES = ("file", "outer", "window", "rest_map", "flat_field", "poses")
"""Keys under which names of files stand."""

_Turns = dict[int, list[tuple[Any, int]]]
"""By the identity of a choice's list: its options, each once for every corner that it takes, with their numbers."""
Chooser = Callable[[str, list[Any]], Any]
"""Kind and arguments of a distribution -> a value; of a choice, the option, which may hold distributions again."""


@dataclass(frozen=True)
class Template:
    """A loaded scene file: the parsed TOML after overrides, and the keys that these gave values.

    The source is the file, for messages and as the place that files are relative to.
    """

    content: dict[str, Any]
    source: Path
    changed: tuple[str, ...] = ()

    def __getstate__(self) -> dict[str, Any]:
        """Without the corners: a process that is started with more than a pipe holds keeps its parent waiting."""
        return {name: value for name, value in self.__dict__.items() if name != "corners"}

    @property
    def name(self) -> str:
        return str(self.content["name"])

    @property
    def label(self) -> str:
        """Where the content comes from, for messages."""
        return f"{self.source} with --set {', '.join(self.changed)}" if self.changed else str(self.source)

    @cached_property
    def hash(self) -> str:
        """SHA-256 (16 hex digits) of what decides pixels: scene less description and references, and files."""
        decisive = {key: value for key, value in self.content.items() if key not in ("description", "references")}
        digest = hashlib.sha256(json.dumps(decisive, sort_keys=True).encode())
        for _, file in self._files():
            with open_file(file) as opened:
                digest.update(hashlib.file_digest(opened, "sha256").digest())
        return digest.hexdigest()[:16]

    @cached_property
    def corners(self) -> tuple[Scene, ...]:
        """The scene at the lower ends, at the upper ends, and with every option of every choice taken once.

        InputError where one of them breaks the schema.
        """
        count = _options(self.content)
        if count > MOST_OPTIONS:
            raise InputError(f"{self.label}: its choices have {count} options; allowed are {MOST_OPTIONS}")
        turns: _Turns = {}
        contents = (_corner(self.content, high, turn, turns) for turn in range(count) for high in (False, True))
        return tuple(dict.fromkeys(validated(content, self.label, Scene) for content in contents))

    @property
    def folder(self) -> Path:
        """What the files that the scene names are relative to."""
        return self.source.parent

    @property
    def numerics(self) -> Numerics:
        """The same for all samples, as are outputs and sampling."""
        return self.corners[0].numerics

    @property
    def outputs(self) -> Outputs:
        return self.corners[0].outputs

    @property
    def sampling(self) -> Sampling:
        return self.corners[0].sampling

    def distributions(self) -> list[tuple[str, Any, str]]:
        """Kind, arguments and path of every distribution, nested ones after their choice."""
        return list(_distributions(self.content, ""))

    def _files(self) -> list[tuple[str, Path]]:
        """Every file that a scene is read from but the gel's, with the key that names it, without repetition."""
        names = set()
        for contact, sensor in ((corner.contact, corner.sensor) for corner in self.corners):
            parts: dict[str, Any] = {"contact.indenter": contact.indenter, "sensor.pattern": sensor.pattern}
            parts |= {f"sensor.{key}": camera for key, camera in sensor.cameras.items()}
            parts["sensor.measured_light"] = sensor.measured_light
            given = [(where, key, getattr(part, key, None)) for where, part in parts.items() for key in FILES]
            names |= {(f"{where}.{key}", name) for where, key, name in given if name}
        return [(key, self.folder / name) for key, name in sorted(names)]


def load_scene(name_or_path: str | Path, set: Sequence[str] = ()) -> Template:
    """Load a shipped scene by its name or any scene by its path.

    Args:
        name_or_path: "gelsight_mini" or "my/sensor.toml".
        set: "key.path=value" with a TOML value; list entries by number ("sensor.lights.0.power=2"). Files are
            relative to the working directory, not to the scene.

    Returns:
        The checked scene, whose numbers may still be distributions.

    Raises:
        InputError: no such scene, wrong TOML, unknown keys, impossible values.

    Examples:
        >>> scene = load_scene("deltact", set=["motion.depth_mm=1.0"])
        >>> scene.name, scene.content["motion"]["depth_mm"]
        ('deltact', 1.0)
    """
    if isinstance(set, str) or not all(isinstance(each, str) for each in set):
        raise InputError(f"set = {set!r}: a list of texts is needed, as in set=['motion.depth_mm=1.2']")
    path = _find(name_or_path)
    content = _read(path)
    for override in set:
        _apply(content, override)
    changed = tuple(override.partition("=")[0].strip() for override in set)
    content = json.loads(json.dumps(content, default=str))  # TOML's dates become text
    return checked_template(with_files(content, partial(_matching, path.parent, [MOST_FOLDERS])), path, changed)


def checked_template(content: dict[str, Any], source: Path, changed: tuple[str, ...] = ()) -> Template:
    """A template whose distributions, corners and mesh files have been checked; InputError says what is wrong."""
    template = Template(with_poses(content, source.parent), source, changed)
    try:
        template = replace(template, content=measured(template.content, source.parent))
    except ValueError as error:
        raise InputError(f"{template.label}: sensor.gel: {error}") from None
    for kind, arguments, where in template.distributions():
        problem = _distribution_problem(kind, arguments, where)
        if problem:
            raise InputError(f"{template.label}: {where}: {problem}")
    for key, file in template._files():
        if file.is_dir():
            raise InputError(f"{template.label}: {key}: {file} is a folder; end it in /*.stl to take its files")
        if not file.is_file():
            raise InputError(f"{template.label}: {key}: there is no file {file}")
    return template


def shipped_scenes() -> list[str]:
    return sorted(path.stem for path in SCENES.glob("*.toml"))


def replaced(value: Any, choose: Chooser) -> Any:
    """A part of a template with every distribution replaced by what `choose` returns for it.

    Tables are gone through in the order of their keys' names, so that the order of a file's lines decides nothing.
    """
    if _is_distribution(value):
        ((kind, arguments),) = value.items()
        chosen = choose(kind, arguments)
        return replaced(chosen, choose) if kind == "choice" else chosen
    if isinstance(value, dict):
        return {key: replaced(value[key], choose) for key in sorted(value)}
    if isinstance(value, list):
        return [replaced(inner, choose) for inner in value]
    return value


def with_files(value: Any, change: Callable[[str], Any], key: str = "") -> Any:
    """A part of a template, the one under `key`, with every name of a file in it replaced by what `change` returns."""
    if isinstance(value, dict):
        return {name: with_files(part, change, key if name in DISTRIBUTIONS else name) for name, part in value.items()}
    if isinstance(value, list):
        return [with_files(inner, change, key) for inner in value]
    return change(value) if key in FILES and isinstance(value, str) else value


def _read(path: Path, above: tuple[Path, ...] = ()) -> dict[str, Any]:
    """The content of a scene file; what it `extends` (a shipped scene, or a file beside it) has the rest.

    `above` are the files that extend it.
    """
    content = read_toml(path)
    if "extends" not in content:
        if not content:
            raise InputError(f'{path}: is empty; a scene may begin with extends = "gelsight_mini"')
        if close := get_close_matches("extends", content, n=1):
            raise InputError(f"{path}: {close[0]}: unknown key; did you mean 'extends'?")
        return content
    given = content.pop("extends")
    if not isinstance(given, str):
        raise InputError(f"{path}: extends = {given!r}: must be the name of a shipped scene or a TOML file")
    try:
        base = _find(path.parent / given if given.endswith(".toml") else given)
    except InputError as error:
        raise InputError(f"{path}: extends = {given!r}: {error}") from error
    if base in (path, *above):
        raise InputError(f"{path}: extends = {given!r}: a scene cannot extend itself")
    below = with_files(_read(base, (path, *above)), lambda name: str(base.parent.absolute() / name))
    name = re.sub(r"[^A-Za-z0-9_\-]", "_", path.stem)
    return _extended({**below, "name": name, "description": "", "references": []}, content)


def _extended(below: dict[str, Any], content: dict[str, Any]) -> dict[str, Any]:
    """A table over another: tables within it alike, but one that says its kind, shape or poses replaces it."""
    both = dict(below)
    for key, value in content.items():
        tables = all(isinstance(each, dict) and not _is_distribution(each) for each in (value, below.get(key)))
        replaces = not tables or "poses" in value or ("kind" if "kind" in below[key] else "shape") in value
        both[key] = value if replaces else _extended(below[key], value)
    return both


def _find(name_or_path: str | Path) -> Path:
    path = Path(name_or_path)
    if path.is_file():
        return path
    shipped = SCENES / f"{name_or_path}.toml"
    if shipped.is_file():
        return shipped
    if path.is_dir():
        raise InputError(f"{path} is a folder, not a scene: give a .toml file in it")
    if path.suffix == ".toml":
        raise InputError(f"there is no scene file {path}")
    raise InputError(
        f"there is no scene {str(name_or_path)!r}; shipped: {', '.join(shipped_scenes())}; or give a .toml file"
    )


def _apply(content: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    steps, told = key.strip().split("."), f"--set {override!r}: "
    if not equals or not all(steps) or len(steps) > DEEPEST or len(override.splitlines()) > 1:
        raise InputError(f"{told}give key=value, for instance --set motion.depth_mm=1.2, in one line")
    value = assigned_value(text, f"--set {key}")
    target: Any = content
    for depth, step in enumerate(steps):
        place: Any = int(step) if isinstance(target, list) and step.isdigit() else step
        if isinstance(target, list) and not (isinstance(place, int) and place < len(target)):
            raise InputError(f"{told}{step!r} is not an entry of a list of {len(target)} (0 is the first)")
        if _is_distribution(target):
            above = ".".join(steps[:depth])
            raise InputError(f"{told}{above} is a distribution; give all of it, as in --set '{above}=...'")
        if not isinstance(target, list | dict):
            raise InputError(f"{told}{step!r} lies inside a value that is not a table")
        if depth == len(steps) - 1:
            target[place] = with_files(value, os.path.abspath, step)
        elif isinstance(target, dict):
            target = target.setdefault(step, {})
        else:
            target = target[place]


def _matching(folder: Path, left: list[int], name: str) -> Any:
    """The name of a file in a folder, or a choice of the files that match it; `left` as for `matching_files`."""
    found = [] if (folder / name).is_file() else matching_files(folder, name, left)
    return {"choice": found} if found else name


def _is_distribution(value: Any) -> bool:
    return isinstance(value, dict) and len(value) == 1 and next(iter(value)) in DISTRIBUTIONS


def _distributions(value: Any, where: str) -> Iterator[tuple[str, Any, str]]:
    if _is_distribution(value):
        ((kind, arguments),) = value.items()
        yield kind, arguments, where
        if kind == "choice" and isinstance(arguments, list):
            for i, option in enumerate(arguments):
                yield from _distributions(option, f"{where}.choice[{i}]")
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from _distributions(inner, f"{where}.{key}" if where else key)
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from _distributions(inner, f"{where}[{i}]")


def _options(value: Any) -> int:
    """How many corners it takes to see every option of every choice in a part of a template."""
    if _is_distribution(value):
        return sum(_options(option) for option in value["choice"]) if "choice" in value else 1
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return max((_options(part) for part in inner), default=1)


def _corner(value: Any, high: bool, turn: int, turns: _Turns) -> Any:
    """The lower or upper end of a part of a template, with the options of its choices that this turn shows."""

    def choose(kind: str, arguments: list[Any]) -> Any:
        if kind != "choice":
            return float(arguments[0] if kind == "normal" or not high else arguments[1])  # as drawn: never whole
        if id(arguments) not in turns:
            turns[id(arguments)] = [(option, own) for option in arguments for own in range(_options(option))]
        option, own = turns[id(arguments)][turn % len(turns[id(arguments)])]
        return _corner(option, high, own, turns)

    return replaced(value, choose)


def _distribution_problem(kind: str, arguments: Any, where: str) -> str:
    if where.split(".")[0].split("[")[0] in FIXED:
        return f"a distribution is not allowed here; {', '.join(FIXED)} are the same for all samples"
    if kind == "choice":
        return "" if isinstance(arguments, list) and arguments else "choice needs a list with at least one entry"
    if not isinstance(arguments, list) or len(arguments) != 2 or not all(map(_is_number, arguments)):
        return f"{kind} needs two finite numbers, it has {arguments!r}"
    if kind == "normal":
        return "" if arguments[1] >= 0 else f"normal's standard deviation must not be negative, it is {arguments[1]}"
    if arguments[0] > arguments[1]:
        return f"{kind} needs [lower, upper], it has {arguments}"
    if kind == "log_uniform" and arguments[0] <= 0:
        return f"log_uniform needs positive ends, it has {arguments}"
    return ""


def _is_number(value: Any) -> bool:
    """Finite, and not so large that a difference overflows."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
