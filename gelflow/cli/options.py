"""Options that several commands share."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter, Token

from gelflow.errors import InputError

MAXIMUM_PIXELS = 4096 * 4096
"""Largest size at which a network may be asked to work; it takes at least 0.9 kB of memory for each pixel."""

Paths = Annotated[
    list[Path], Parameter(help="Datasets or *.tar shards of synth, folders by 'pairs', or of NAME_1.png, NAME_2.png.")
]
AsJson = Annotated[bool, Parameter("--json", negative=(), help="Print the answer as JSON on stdout.")]
Size = Annotated[str | None, Parameter(help="ROWSxCOLUMNS at which the network works; see the guide for the default.")]
Out = Annotated[Path, Parameter(help="Folder for the results.")]
ShippedOrFile = Annotated[
    Path | None, Parameter(help="File of weights, or fast; default: those that come with the package, best.")
]
Device = Literal["auto", "cpu", "cuda"]
OnDevice = Annotated[
    Device, Parameter(help="Where networks and registration run; auto: a CUDA device where there is one.")
]
Registered = Literal["none", "motion", "both", "brightness"]
Registration = Annotated[
    Registered | None,
    Parameter(
        help="How to correct the network's flow. motion: follow the gel; brightness: bring image 2 as close to image 1 "
        "as possible, shading included; both: brightness only where motion leaves a large difference. Default: as the "
        "weights state; best: motion."
    ),
]
Places = Annotated[
    Path | None, Parameter("--scene", help="Markers in mm: EXR file that synth preview --places wrote for the scene.")
]
METHODS = (
    "none, lucas-kanade, farneback, dis-ultrafast, dis-fast, dis-medium, tvl1, dis-motion, dis-both, "
    "dis-brightness, al-dic"
)


def whole(at_least: int) -> Callable[[Any, Sequence[Token]], int]:
    """Converter for a whole number; cyclopts' own would round 1.5 to 2."""

    def convert(_: Any, tokens: Sequence[Token]) -> int:
        text = tokens[0].value
        if not re.fullmatch(r"[+-]?\d{1,18}", text) or int(text) < at_least:
            raise ValueError(f"it is {text!r}, allowed are whole numbers from {at_least} on")
        return int(text)

    return convert


def each_key_once(_: Any, given: Sequence[str] | None) -> None:
    """Refuses a --set that a later one would undo: the same key again, or the table that holds it."""
    keys = [text.partition("=")[0].strip() for text in given or ()]
    for number, key in enumerate(keys):
        for earlier in keys[:number]:
            if earlier == key or earlier.startswith(f"{key}."):
                raise ValueError(f"{key} undoes the earlier {earlier}; give each key once, a table before its fields")


def parse_size(text: str | None) -> tuple[int, int] | None:
    """ROWSxCOLUMNS as numbers; InputError for other text and for sizes beyond `MAXIMUM_PIXELS`."""
    if text is None:
        return None
    rows, _, columns = text.lower().partition("x")
    if not all(re.fullmatch(r"[0-9]{1,9}", side) for side in (rows, columns)):
        raise InputError(f"--size {text}: ROWSxCOLUMNS is needed, for instance --size 512x640")
    if int(rows) * int(columns) > MAXIMUM_PIXELS:
        raise InputError(
            f"--size {text}: at most {MAXIMUM_PIXELS} px are allowed, such as 4096x4096, which takes 15 GB of memory"
        )
    return int(rows), int(columns)
