"""Flow fields in OpenEXR files, with the channels of a synth dataset's `flow.exr`.

    forward.U forward.V forward.visible     I1(x) = I2(x + forward(x))
    backward.U backward.V backward.visible  the same with the images exchanged
    previous.U previous.V previous.visible  of a clip's frame: from the frame before, as forward, at its pixels
    forward.sigma                           of an estimate: radius in px within which 68 % of such flows are right

float32, ZIP-compressed; U right, V down, px of the image; a flow belongs to its pixel's centre, (c + 0.5, r + 0.5).
`visible` is 1 where the point of the pixel is seen in the other image, 0 where it is hidden or has left the image;
U and V are NaN only where the pixel sees no gel. Of an estimate it is a probability.

Beside it, Middlebury's .flo format (Baker et al. 2011, vision.middlebury.edu/flow). Little-endian: float32 202021.25,
int32 width, int32 height, then height x width x (u, v) float32, row by row. By the format's convention a value above
1e9 means unknown; here unknown flow is NaN in memory and 1e10 in the file.
"""

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from gelflow.arrays import FlowArray, MapArray, MaskArray
from gelflow.errors import InputError
from gelflow.files.atomic import replacing
from gelflow.files.quiet import quiet
from gelflow.untrusted import MOST_VALUES

DIRECTIONS = "U right, V down; I1(x) = I2(x + forward(x))"
"""Text in the header of every flow that gelflow writes, by which its files are known."""
Direction = Literal["forward", "backward", "previous"]


class FlowField(NamedTuple):
    """A flow (H, W, 2) in px, where its end point is seen, and where the gel is touched in state 2, both (H, W) bool.

    The contact is at the pixels of image 1, and None where the file lacks it or the flow is the backward one. Sigma is
    (H, W) px, and None where the file lacks it.
    """

    flow: FlowArray
    visible: MaskArray
    contact: MaskArray | None = None
    sigma: MapArray | None = None


def read_channels(path: Path) -> dict[str, NDArray[np.float32]]:
    """All channels (H, W) of an EXR file by name, as float32; InputError if missing, none, truncated or damaged."""
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    try:
        with quiet(), OpenEXR.File(str(path), header_only=True) as file:
            header, parts = dict(file.header()), len(file.parts)  # the library empties its own on closing
        low, high = (corner.astype(float) for corner in header["dataWindow"])
        flat = parts == 1 and header["type"] in (OpenEXR.scanlineimage, OpenEXR.tiledimage)
        if not flat or len(header["channels"]) * float(np.prod(high - low + 1)) > MOST_VALUES:
            raise ValueError(f"it is not one flat image of at most {MOST_VALUES} values in all channels")
        with quiet(), OpenEXR.File(str(path), separate_channels=True) as file:
            planes = {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}
        if len({plane.shape for plane in planes.values()}) != 1:
            raise ValueError("its channels differ in size")
        return planes
    except (RuntimeError, ValueError, OSError, TypeError, LookupError, MemoryError) as error:
        raise InputError(f"{path}: not a readable EXR file ({error}); truncated or damaged?") from error


def read_flow(path: Path, direction: Direction = "forward") -> FlowField:
    """One direction of a flow file. A file without a `visible` channel is visible wherever the flow is finite.

    InputError where the file cannot be read, or lacks the U or V channel of this direction.
    """
    channels = read_channels(path)
    needed = [f"{direction}.U", f"{direction}.V"]
    missing = [name for name in needed if name not in channels]
    if missing:
        present = ", ".join(sorted(channels)) or "none"
        raise InputError(f"{path}: lacks the channel {' and '.join(missing)}; it has: {present}")
    flow = np.stack([channels[name] for name in needed], axis=-1)
    if (np.abs(flow) > 1e6).any():
        raise InputError(f"{path}: holds a flow of more than 1e6 px; where no gel is seen it must be NaN")
    finite = np.isfinite(flow).all(axis=-1)
    visible = channels.get(f"{direction}.visible")
    seen = finite if visible is None else np.logical_and(finite, visible > 0.5)
    touched = channels.get("contact.Y") if direction == "forward" else None
    contact = None if touched is None else np.asarray(touched > 0.5, np.bool_)
    return FlowField(flow, np.asarray(seen, np.bool_), contact, channels.get(f"{direction}.sigma"))


def write_flow(
    path: Path, forward: FlowArray, visible: MaskArray | MapArray | None = None, sigma: MapArray | None = None
) -> None:
    """Writes a forward flow, and where it is visible and its sigma if they are known; replaces the file as a whole."""
    planes = {f"forward.{name}": np.ascontiguousarray(forward[..., k], np.float32) for k, name in enumerate("UV")}
    if visible is not None:
        planes["forward.visible"] = visible.astype(np.float32)
    if sigma is not None:
        planes["forward.sigma"] = sigma
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "flow.units": "px",
        "flow.directions": DIRECTIONS,
        "flow.pixelCentre": "pixel (c, r) has its centre at (c + 0.5, r + 0.5); the flow belongs to the centre",
    }
    with replacing(path) as temporary:
        try:
            OpenEXR.File(header, planes).write(str(temporary))  # it prints nothing, and a thread may be here
        except RuntimeError as error:
            raise OSError(f"cannot write {path}: {error}") from error


MAGIC = np.float32(202021.25)
UNKNOWN = np.float32(1e10)


def write_flo(path: Path, flow: FlowArray) -> None:
    """Writes a flow (H, W, 2) in px; NaN becomes the format's unknown flow. Replaces the file as a whole."""
    height, width = flow.shape[:2]
    data = np.where(np.isnan(flow), UNKNOWN, flow).astype("<f4")
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(MAGIC.astype("<f4").tobytes() + np.array([width, height], "<i4").tobytes() + data.tobytes())
