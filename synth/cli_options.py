"""Options that several commands share. Nothing heavy is imported."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter, Token


def whole(at_least: int) -> Callable[[Any, Sequence[Token]], int]:
    """Converter for a whole number; cyclopts' own would round 1.5 to 2."""

    def convert(_: Any, tokens: Sequence[Token]) -> int:
        text = tokens[0].value
        if not re.fullmatch(r"[+-]?\d+", text) or int(text) < at_least:
            raise ValueError(f"it is {text!r}, allowed are whole numbers from {at_least} on")
        return int(text)

    return convert


def each_key_once(_: Any, given: Sequence[str] | None) -> None:
    """Validator: no assignment is undone by a later one."""
    keys = [text.partition("=")[0].strip() for text in given or ()]
    for number, key in enumerate(keys):
        for earlier in keys[:number]:
            if earlier == key or earlier.startswith(f"{key}."):
                raise ValueError(f"{key} undoes the earlier {earlier}; give each key once, a table before its fields")


SceneName = Annotated[str, Parameter(name="--scene", help="A shipped scene's name or a TOML file.")]
Assignments = Annotated[
    list[str] | None,
    Parameter(
        "--set", validator=each_key_once, help="KEY=VALUE with a TOML value, such as motion.depth_mm=1.2; repeatable."
    ),
]
Device = Annotated[Literal["auto", "cpu", "cuda"], Parameter(help="Where to render; auto: a GPU with OptiX, if any.")]
AsJson = Annotated[bool, Parameter("--json", negative=(), help="Print the answer as JSON on stdout.")]
Dataset = Annotated[Path, Parameter(help="A dataset directory.")]

DEFAULT_SCENE = "gelsight_mini"
Format = Annotated[
    Literal["flo", "kitti", "npz", "webdataset", "hdf5", "lerobot", "rrd"], Parameter(help="Layout to write.")
]
