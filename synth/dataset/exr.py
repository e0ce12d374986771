"""`flow.exr`: an exact flow as an OpenEXR image, float32, ZIP-compressed.

Of a clip `flow/000001.exr`, whose image 1 is frame 0 and image 2 frame 1.

Channels (of two directions, both read `I1(x) = I2(x + forward(x))`, `I2(x) = I1(x + backward(x))`):

    forward.U forward.V forward.visible   backward.U backward.V backward.visible
    and by name whatever FlowField.extras holds: see `OPTIONAL`; vectors are in the scene's frame (dataset.json:
    conventions.frame), "in image 1" is at the pixels of image 1
    R G B    the same numbers as forward.U forward.V forward.visible once more

U is right, V is down, px at the pixel's centre (c + 0.5, r + 0.5); NaN where the pixel sees no gel. R, G, B are there
for programs that know no named channels: tev shows them first, and OpenCV reads nothing else. An OpenCV built with
OpenEXR (its 4.x wheels are, with OPENCV_IO_ENABLE_OPENEXR=1 set before the import; its 5.0 wheels are not) gives with
`cv2.imread(path, cv2.IMREAD_UNCHANGED)` an (H, W, 3) float32 image of [visible, V, U]. ZIP compression finds the
repetition: it costs 2 % of the file.

Reference: OpenEXR file layout, https://openexr.com/en/latest/OpenEXRFileLayout.html
"""

import contextlib
import io
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.errors import InputError
from synth.flow.field import FlowArray, FlowField
from synth.untrusted import MOST_VALUES, open_file

ALIASES = {"R": "forward.U", "G": "forward.V", "B": "forward.visible"}
CONVENTIONS = {
    "flow.units": "px",
    "flow.directions": "I1(x) = I2(x + forward(x)), I2(x) = I1(x + backward(x)); U is +x, right; V is +y, down",
    "flow.pixelCentre": "pixel (column c, row r) has its centre at (c + 0.5, r + 0.5); its flow belongs to the centre",
    "flow.visible": "1 where the pixel's material point is seen in the other image, else 0; U and V hold there, too",
    "flow.nan": "the pixel sees no gel",
    "flow.aliases": "R = forward.U, G = forward.V, B = forward.visible",
}
"""Header attributes of every file; those of optional channels come beside them."""

_PARTS = ("U", "V", "visible")

OPTIONAL: dict[str, tuple[tuple[str, ...], str]] = {
    "depth": (
        ("depth1.Z", "depth2.Z"),
        "mm; distance of the surface point from the camera along its viewing axis, straight through the window; "
        "1 in image 1, 2 in image 2",
    ),
    "normal": (
        tuple(f"normal{image}.{axis}" for image in (1, 2) for axis in "XYZ"),
        "unit vector, frame of the scene; from the surface into the gel; 1 in image 1, 2 in image 2",
    ),
    "displacement": (
        ("displacement.X", "displacement.Y", "displacement.Z"),
        "mm, frame of the scene; place in image 2's state less that in image 1's; in image 1",
    ),
    "traction": (
        ("traction.X", "traction.Y", "traction.Z"),
        "MPa, frame of the scene; force of the indenter on the gel per undeformed area, in image 2's state; in image 1",
    ),
    "contact": (("contact.Y",), "1 where the indenter touches in image 2's state, else 0; in image 1"),
    "slip": (
        ("slip.Y",),
        "1 where the point moved along the indenter since the frame before, 0 where it stuck, NaN without contact; in "
        "image 1",
    ),
    "previous": (
        ("previous.U", "previous.V", "previous.visible"),
        "px; as forward, from the frame before image 2 to image 2, in the frame before",
    ),
}
"""Names of channels, and their unit, frame, state and image, by the key of `[outputs]` that asks for them."""


def write_flow(path: Path, flow: FlowField, attributes: Mapping[str, str | int]) -> None:
    """Writes a flow field in the place of an older file; the same field and attributes give the same bytes.

    `attributes`, whose integers must fit 32 bits, stand in the header beside `CONVENTIONS`. OSError where the storage
    refuses.
    """
    planes = channels_of(flow)
    planes |= {alias: planes[name] for alias, name in ALIASES.items()}
    meanings = {f"channels.{key}": meaning for key, (names, meaning) in OPTIONAL.items() if set(names) <= set(planes)}
    write_channels(path, planes, {**CONVENTIONS, **meanings, **attributes})


def write_channels(path: Path, planes: Mapping[str, FlowArray], attributes: Mapping[str, str | int]) -> None:
    """Writes planes (H, W) float32 by channel name; otherwise as `write_flow`."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **attributes}
    try:
        OpenEXR.File(header, dict(planes)).write(str(path))
    except RuntimeError as error:  # How the library reports a failing disk.
        raise OSError(str(error)) from error


def channels_of(flow: FlowField) -> dict[str, FlowArray]:
    """The field's planes (H, W) float32 by channel name, without the aliases."""
    planes: dict[str, FlowArray] = {}
    for direction, motion, visible in (
        ("forward", flow.forward, flow.forward_visible),
        ("backward", flow.backward, flow.backward_visible),
    ):
        if motion is None or visible is None:
            continue
        planes[f"{direction}.U"] = motion[..., 0]
        planes[f"{direction}.V"] = motion[..., 1]
        planes[f"{direction}.visible"] = visible
    planes |= flow.extras
    return {name: np.ascontiguousarray(plane, np.float32) for name, plane in planes.items()}


def read_flow(path: Path) -> FlowField:
    """The flow field in a file; InputError where it is damaged or a part of a flow is missing."""
    return flow_of(path, read_channels(path)[0])


def flow_of(path: Path, channels: Mapping[str, NDArray[Any]]) -> FlowField:
    """Sorts channels into a field; `path` is for the message.

    InputError where a channel of the forward flow, or a part of the backward flow, is missing.
    """
    forward = _direction(path, channels, "forward")
    given = any(name.startswith("backward.") for name in channels)
    backward, seen = _direction(path, channels, "backward") if given else (None, None)
    own = {*ALIASES, *(f"{direction}.{part}" for direction in ("forward", "backward") for part in _PARTS)}
    extras = {name: plane.astype(np.float32) for name, plane in channels.items() if name not in own}
    return FlowField(*forward, backward=backward, backward_visible=seen, extras=extras)


def _direction(path: Path, channels: Mapping[str, NDArray[Any]], direction: str) -> tuple[FlowArray, FlowArray]:
    """(H, W, 2) flow and (H, W) visibility."""
    names = [f"{direction}.{part}" for part in _PARTS]
    missing = [name for name in names if name not in channels]
    if missing:
        present = ", ".join(sorted(channels)) or "none"
        raise InputError(f"{path}: lacks the channel {' and '.join(missing)}; it has {present}")
    u, v, visible = (channels[name].astype(np.float32) for name in names)
    if (np.abs([u, v]) > 1e6).any() or not (np.abs(visible) <= 1).all():
        raise InputError(f"{path}: {direction} flow must be below 1e6 px, or NaN, and visible between 0 and 1")
    return np.stack([u, v], axis=-1), visible


@contextlib.contextmanager
def _silenced() -> Iterator[None]:
    """Drops what the library prints of a damaged file, through Python and to the descriptors 1 and 2."""
    saved, null = [os.dup(1), os.dup(2)], os.open(os.devnull, os.O_WRONLY)
    try:
        for place in (1, 2):
            os.dup2(null, place)
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            yield
    finally:
        for place, former in enumerate(saved, 1):
            os.dup2(former, place)
        for descriptor in (*saved, null):
            os.close(descriptor)


def read_channels(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, str | int]]:
    """All channels (H, W) by name, float32 in a file of ours, and the header's text and integer attributes.

    InputError where it is missing, no OpenEXR image, truncated or damaged, or its channels differ in size.
    """
    import OpenEXR

    try:
        open_file(path).close()
        with _silenced(), OpenEXR.File(str(path), header_only=True) as file:
            header, parts = dict(file.header()), len(file.parts)  # the library empties its own on closing
            low, high = (corner.astype(float) for corner in header["dataWindow"])
        flat = parts == 1 and header["type"] in (OpenEXR.scanlineimage, OpenEXR.tiledimage)
        if not flat or len(header["channels"]) * float(np.prod(high - low + 1)) > MOST_VALUES:
            raise ValueError(f"it is not one flat image of at most {MOST_VALUES} values in all channels")
        with _silenced(), OpenEXR.File(str(path), separate_channels=True) as file:
            planes = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file") from None
    except (RuntimeError, ValueError, OSError, TypeError, LookupError, MemoryError) as error:
        raise InputError(f"{path}: cannot be decoded as OpenEXR ({error}); it is truncated or damaged") from error
    shapes = {plane.shape for plane in planes.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2:
        raise InputError(f"{path}: its channels have the sizes {sorted(shapes)}; a flow file's are all height x width")
    return planes, {key: value for key, value in header.items() if isinstance(value, (str, int))}
