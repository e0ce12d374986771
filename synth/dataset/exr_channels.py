"""The optional channels of flow.exr: which there are for each key of `[outputs]`, and what the header says of them.

Vectors are in the scene's frame (dataset.json: conventions.frame). "In image 1" is at the pixels of image 1.
"""

from collections.abc import Collection
from dataclasses import dataclass


@dataclass(frozen=True)
class Channels:
    """Channels that come together.

    Attributes:
        names: as in the file.
        meaning: their unit, their frame, and of which state and image they are.
    """

    names: tuple[str, ...]
    meaning: str


def _vector(name: str) -> tuple[str, ...]:
    return tuple(f"{name}.{axis}" for axis in "XYZ")


OPTIONAL = {
    "depth": Channels(
        ("depth1.Z", "depth2.Z"),
        "mm; distance of the surface point from the camera along its viewing axis, straight through the window; "
        "1 in image 1, 2 in image 2",
    ),
    "normal": Channels(
        _vector("normal1") + _vector("normal2"),
        "unit vector, frame of the scene; from the surface into the gel; 1 in image 1, 2 in image 2",
    ),
    "displacement": Channels(
        _vector("displacement"), "mm, frame of the scene; place in image 2's state less that in image 1's; in image 1"
    ),
    "traction": Channels(
        _vector("traction"),
        "MPa, frame of the scene; force of the indenter on the gel per undeformed area, in image 2's state; in image 1",
    ),
    "contact": Channels(("contact.Y",), "1 where the indenter touches in image 2's state, else 0; in image 1"),
}
"""By the key of `[outputs]`."""


def meanings(written: Collection[str]) -> dict[str, str]:
    """Header attributes for the optional channels among those that a file holds."""
    return {f"channels.{key}": part.meaning for key, part in OPTIONAL.items() if set(part.names) <= set(written)}
