"""A scene file: TOML in which any number may be a distribution.

    { uniform = [a, b] }   { normal = [mean, sd] }   { log_uniform = [a, b] }   { choice = [...] }

`choice` may hold whole tables (indenters, say) with distributions inside. A file is checked when it is loaded: at the
lower and upper end of all its distributions and for every choice, so that a mistake shows before any work is done.
"""

import hashlib
import json
import tomllib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from synth.errors import InputError
from synth.scene import Scene

SCENES = Path(__file__).resolve().parent.parent / "scenes"
"""The shipped scene files."""
DISTRIBUTIONS = ("uniform", "normal", "log_uniform", "choice")
FIXED = ("name", "description", "references", "numerics", "outputs", "sampling")
"""Parts that all samples of a dataset share."""

Resolver = Callable[[str, list[Any], str], Any]
"""Kind, arguments and path of a distribution -> a value."""


@dataclass(frozen=True)
class Template:
    """A loaded scene file.

    Attributes:
        content: the parsed TOML after overrides.
        source: the file, for messages and as the place that mesh files are relative to.
    """

    content: dict[str, Any]
    source: Path

    @property
    def name(self) -> str:
        """The scene's name."""
        return str(self.content["name"])

    @cached_property
    def hash(self) -> str:
        """SHA-256 (16 hex digits) of everything that decides pixels: all but description and references."""
        decisive = {key: value for key, value in self.content.items() if key not in ("description", "references")}
        return hashlib.sha256(json.dumps(decisive, sort_keys=True).encode()).hexdigest()[:16]

    def resolve(self, resolver: Resolver) -> Scene:
        """The scene with every distribution replaced by what `resolver` returns for it.

        Raises:
            InputError: the result breaks the schema.
        """
        return validated(_replaced(self.content, resolver, ""), self.source)

    @cached_property
    def corners(self) -> tuple[Scene, ...]:
        """The scene at the lower ends, at the upper ends, and with every choice taken once."""
        widest = max([1, *(len(arguments) for kind, arguments, _ in self.distributions() if kind == "choice")])
        scenes = [self.resolve(_end(high, turn)) for turn in range(widest) for high in (False, True)]
        return tuple(dict.fromkeys(scenes))

    def distributions(self) -> list[tuple[str, list[Any], str]]:
        """Kind, arguments and path of every distribution, nested ones after their choice."""
        return list(_distributions(self.content, ""))


def load_scene(name_or_path: str | Path, overrides: Sequence[str] = ()) -> Template:
    """Load a shipped scene by its name or any scene by its path.

    Args:
        name_or_path: "gelsight_mini" or "my/sensor.toml".
        overrides: "key.path=value" with a TOML value; list entries by number ("sensor.lights.0.power=2").

    Raises:
        InputError: no such scene, wrong TOML, unknown keys, impossible values.
    """
    path = _find(name_or_path)
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid TOML: {error}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    for override in overrides:
        _apply(content, override)
    return checked_template(content, path)


def checked_template(content: dict[str, Any], source: Path) -> Template:
    """A template whose distributions and corners have been checked.

    Raises:
        InputError: what is wrong, where.
    """
    template = Template(content, source)
    for kind, arguments, where in template.distributions():
        problem = _distribution_problem(kind, arguments, where)
        if problem:
            raise InputError(f"{source}: {where}: {problem}")
    template.corners  # noqa: B018  (validates)
    return template


def shipped_scenes() -> list[str]:
    """Names of the scenes that come with the program."""
    return sorted(path.stem for path in SCENES.glob("*.toml"))


def validated(content: dict[str, Any], source: Path) -> Scene:
    """A Scene of plain content.

    Raises:
        InputError: one line per problem with file, path, what was given and what is allowed.
    """
    try:
        return Scene.model_validate(content)
    except ValidationError as error:
        lines = [_explain(problem, content) for problem in error.errors()]
        raise InputError("\n".join(f"{source}: {line}" for line in dict.fromkeys(lines))) from error


def _find(name_or_path: str | Path) -> Path:
    path = Path(name_or_path)
    if path.suffix == ".toml" or path.exists():
        if path.is_file():
            return path
        raise InputError(f"there is no scene file {path}")
    shipped = SCENES / f"{name_or_path}.toml"
    if shipped.is_file():
        return shipped
    raise InputError(
        f"there is no scene {str(name_or_path)!r}; shipped: {', '.join(shipped_scenes())}; or give a .toml file"
    )


def _apply(content: dict[str, Any], override: str) -> None:
    """Set one value of the parsed TOML."""
    key, equals, text = override.partition("=")
    steps = key.strip().split(".")
    if not equals or not all(steps):
        raise InputError(f"--set {override!r}: give key=value, for instance --set motion.depth_mm=1.2")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text.strip()  # a bare word is a string
    target: Any = content
    for step, following in zip(steps, [*steps[1:], None], strict=True):
        place: Any = int(step) if isinstance(target, list) and step.isdigit() else step
        if isinstance(target, list) and not (isinstance(place, int) and place < len(target)):
            raise InputError(f"--set {override!r}: {step!r} is not an entry of a list of {len(target)}")
        if not isinstance(target, list | dict):
            raise InputError(f"--set {override!r}: {step!r} lies inside a value that is not a table")
        if following is None:
            target[place] = value
        elif isinstance(target, dict):
            target = target.setdefault(step, {})
        else:
            target = target[place]


def _is_distribution(value: Any) -> bool:
    return isinstance(value, dict) and len(value) == 1 and next(iter(value)) in DISTRIBUTIONS


def _distributions(value: Any, where: str) -> Iterable[tuple[str, list[Any], str]]:
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


def _replaced(value: Any, resolver: Resolver, where: str) -> Any:
    if _is_distribution(value):
        ((kind, arguments),) = value.items()
        chosen = resolver(kind, arguments, where)
        return _replaced(chosen, resolver, where) if kind == "choice" else chosen
    if isinstance(value, dict):
        return {key: _replaced(inner, resolver, f"{where}.{key}" if where else key) for key, inner in value.items()}
    if isinstance(value, list):
        return [_replaced(inner, resolver, f"{where}[{i}]") for i, inner in enumerate(value)]
    return value


def _end(high: bool, turn: int) -> Resolver:
    def resolver(kind: str, arguments: list[Any], where: str) -> Any:
        if kind == "choice":
            return arguments[turn % len(arguments)]
        if kind == "normal":
            return arguments[0]
        return arguments[1 if high else 0]

    return resolver


def _distribution_problem(kind: str, arguments: Any, where: str) -> str:
    if where.split(".")[0].split("[")[0] in FIXED:
        return f"a distribution is not allowed here; {', '.join(FIXED)} are the same for all samples"
    if kind == "choice":
        return "" if isinstance(arguments, list) and arguments else "choice needs a list with at least one entry"
    numbers = isinstance(arguments, list) and len(arguments) == 2
    if not numbers or not all(isinstance(a, int | float) and not isinstance(a, bool) for a in arguments):
        return f"{kind} needs two numbers, it has {arguments!r}"
    if kind == "normal":
        return "" if arguments[1] >= 0 else f"normal's standard deviation must not be negative, it is {arguments[1]}"
    if arguments[0] > arguments[1]:
        return f"{kind} needs [lower, upper], it has {arguments}"
    if kind == "log_uniform" and arguments[0] <= 0:
        return f"log_uniform needs positive ends, it has {arguments}"
    return ""


def _explain(problem: Any, content: dict[str, Any]) -> str:
    """One pydantic error as a line of our own."""
    where, _ = _path(problem["loc"], content)
    if problem["type"] == "extra_forbidden":
        close = get_close_matches(str(problem["loc"][-1]), _field_names(), n=1)
        return f"{where}: unknown key" + (f"; did you mean {close[0]!r}?" if close else "")
    message = problem["msg"].removeprefix("Value error, ")
    message = message[0].lower() + message[1:]
    given = problem["input"]
    shown = "" if isinstance(given, dict) or problem["type"] == "missing" else f" = {given!r}"
    return f"{where}{shown}: {message}" if where else message


def _path(location: Sequence[Any], content: Any) -> tuple[str, Any]:
    """Dotted path without the discriminator tags that pydantic puts in it."""
    where, value = "", content
    for part in location:
        if isinstance(part, int):
            where += f"[{part}]"
            value = value[part] if isinstance(value, list | tuple) and part < len(value) else None
        elif isinstance(value, dict) and part not in value and part in (value.get("kind"), value.get("shape")):
            continue
        else:
            where += f".{part}" if where else str(part)
            value = value.get(part) if isinstance(value, dict) else None
    return where, value


def _field_names() -> list[str]:
    """Every field name of the schema."""
    names: set[str] = set()

    def visit(model: type[BaseModel]) -> None:
        names.update(model.model_fields)
        for subclass in model.__subclasses__():
            visit(subclass)

    from synth.scene import Part

    visit(Part)
    return sorted(names)
