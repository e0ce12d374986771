"""Pictures of flow: the colour wheel with its scale in px, arrows, and the two together.

Colours are Middlebury's (Baker et al., "A Database and Evaluation Methodology for Optical Flow", IJCV 2011): the hue is
the direction, the saturation the length of the flow over an explicit scale in px. The scale is stated on every picture
and follows the flow, so that a flow of some hundredths of a px fills the wheel as well as one of 40 px.
"""

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.arrays import Bytes3, FlowArray, ImageArray, MapArray
from gelflow.files.atomic import replacing
from gelflow.files.image import to_bytes
from gelflow.models.working_size import unknown_px
from gelflow.ops.warp import warp_image

if TYPE_CHECKING:
    from matplotlib.axes import Axes

UNKNOWN_COLOUR = (70, 70, 70)
"""Colour (R, G, B) of pixels without flow."""
_SEGMENTS = (15, 6, 4, 11, 13, 6)
"""Steps from red to yellow, yellow to green, green to cyan, cyan to blue, blue to magenta, magenta to red."""


def colour_wheel() -> NDArray[np.float64]:
    """Middlebury's 55 hues, (55, 3) in [0, 1], from red through yellow, green, cyan, blue and magenta."""
    corners = np.array([[1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1], [1, 0, 1], [1, 0, 0]], float)
    parts = []
    for start, end, steps in zip(corners[:-1], corners[1:], _SEGMENTS, strict=True):
        share = np.arange(steps)[:, None] / steps
        parts.append(start * (1 - share) + end * share)
    return np.concatenate(parts)


def flow_to_colour(flow: FlowArray, scale_px: float) -> Bytes3:
    """Colours of a flow: white where it is zero, full colour at `scale_px`, darker beyond, grey where it is NaN."""
    wheel = colour_wheel()
    unknown = ~np.isfinite(flow).all(axis=-1)
    u, v = (np.where(unknown, 0.0, flow[..., k]) / scale_px for k in (0, 1))
    radius = np.hypot(u, v)[..., None]
    position = (np.arctan2(-v, -u) / np.pi + 1) / 2 * (len(wheel) - 1)
    lower = np.floor(position).astype(int)
    share = (position - lower)[..., None]
    hue = (1 - share) * wheel[lower] + share * wheel[(lower + 1) % len(wheel)]
    colour = np.where(radius <= 1, 1 - radius * (1 - hue), 0.75 * hue)
    picture = np.floor(255 * colour).astype(np.uint8)
    picture[unknown] = UNKNOWN_COLOUR
    return picture


def certain(flow: FlowArray, sigma: MapArray | None) -> FlowArray:
    """The flow with NaN where it is unknown (`unknown_px`)."""
    return flow if sigma is None else np.where(sigma[..., None] > unknown_px(*sigma.shape), np.float32(np.nan), flow)


def robust_scale(flow: FlowArray) -> float:
    """A scale in px for a picture: the 99th percentile of the length, rounded up to two digits; 1 for no flow."""
    length = np.hypot(flow[..., 0], flow[..., 1])
    length = length[np.isfinite(length)]
    return round_up(float(np.percentile(length, 99.0))) if length.size else 1.0


def round_up(value: float) -> float:
    """The next number above with two significant digits; 1 for zero."""
    if not value > 0:
        return 1.0
    unit = 10.0 ** (np.floor(np.log10(value)) - 1)
    return float(np.ceil(value / unit - 1e-9) * unit)


def legend(side: int) -> Bytes3:
    """The colour wheel itself, (side, side, 3) uint8: the centre is no flow, the rim flow of the scale's length."""
    axis = (np.arange(side) + 0.5) * 2 / side - 1
    flow = np.stack(np.meshgrid(axis, axis), axis=-1).astype(np.float32)
    picture = flow_to_colour(flow, 1.0)
    picture[np.hypot(flow[..., 0], flow[..., 1]) > 1] = 255
    return picture


def draw_overlay(frame: Bytes3, flow: FlowArray, scale_px: float) -> Bytes3:
    """A frame of an overlay video: arrows on the frame at the left, colours with their legend at the right.

    An arrow starts where the gel was in the reference frame and ends where it is in this frame. Arrows are as long as
    the motion; where the scale is below 3 px they are enlarged, by a factor that is written on the frame. The picture
    is uint8 RGB, twice as wide as the frame, enlarged to at least 480 rows, both sides even (as video encoders ask).
    """
    height, width = frame.shape[:2]
    zoom = max(1, -(-480 // height))
    left = cv2.resize(frame, (zoom * width, zoom * height), interpolation=cv2.INTER_LINEAR)
    exaggeration = arrow_factor(scale_px)
    step = max(8, width // 24)
    for row in range(step // 2, height, step):
        for column in range(step // 2, width, step):
            u, v = flow[row, column] * exaggeration
            if np.isfinite(u) and np.isfinite(v):
                start = (round(zoom * (column + 0.5)), round(zoom * (row + 0.5)))
                end = (round(zoom * (column + 0.5 + float(u))), round(zoom * (row + 0.5 + float(v))))
                cv2.arrowedLine(left, start, end, (255, 255, 255), 1, cv2.LINE_AA, tipLength=0.3)
    if exaggeration > 1:
        _label(left, f"arrows x {exaggeration:g}", (8, 22))
    right = cv2.resize(flow_to_colour(flow, scale_px), (zoom * width, zoom * height), interpolation=cv2.INTER_NEAREST)
    wheel = legend(min(zoom * height // 5, zoom * width - 16))
    side = wheel.shape[0]
    right[8 : 8 + side, 8 : 8 + side] = wheel
    _label(right, f"rim: {scale_px:g} px", (8, side + 30))
    picture = np.concatenate([left, right], axis=1)
    return np.ascontiguousarray(picture[: picture.shape[0] // 2 * 2])


def draw_sigma(sigma: MapArray, unknown: float) -> Bytes3:
    """Sigma as a picture (H, W, 3): dark at 0, bright below, and grey from `unknown` px on."""
    share = (sigma / unknown).clip(0, 1)
    picture = cv2.applyColorMap(np.rint(255 * share).astype(np.uint8), cv2.COLORMAP_INFERNO)[..., ::-1].copy()
    picture[share >= 1] = UNKNOWN_COLOUR
    return picture


def draw_markers(frame: Bytes3, markers: Iterable[tuple[float, ...]]) -> Bytes3:
    """A frame with a circle at each marker (id, x, y, u, v, ...), px."""
    drawn = frame.copy()
    for _, x, y, u, v, *_ in markers:
        cv2.circle(drawn, (round(x + u - 0.5), round(y + v - 0.5)), 3, (0, 255, 0), 1)
    return drawn


def arrow_factor(scale_px: float) -> float:
    """Enlargement of arrows: the smallest power of ten (1 at least) that makes the scale 3 px long or more."""
    factor = 1.0
    while scale_px * factor < 3.0 and factor < 1e6:
        factor *= 10.0
    return factor


def _label(picture: Bytes3, text: str, origin: tuple[int, int]) -> None:
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.6, 1)
    x, y = origin
    cv2.rectangle(picture, (x - 4, y - height - 5), (x + width + 4, y + below + 2), (255, 255, 255), cv2.FILLED)
    cv2.putText(picture, text, origin, cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 1, cv2.LINE_AA)


def write_flow_picture(
    path: Path, image1: ImageArray, image2: ImageArray, flow: FlowArray, sigma: MapArray, title: str
) -> None:
    """Writes a PNG with both images, the flow as colours with their legend and as arrows, where it is known, and the
    difference of the images before and after the second is warped by the flow.
    """
    from matplotlib.figure import Figure

    known = certain(flow, sigma)
    height, width = flow.shape[:2]
    scale, unknown = robust_scale(known), (sigma > unknown_px(height, width)).mean()
    figure = Figure(figsize=(12, 12 / 3 * 2 * height / width + 1.1), dpi=110, layout="constrained")
    axes = figure.subplots(2, 3)
    before = np.abs(image1 - image2).mean(axis=-1)
    after = np.abs(image1 - warp_image(image2, flow)).mean(axis=-1)
    limit = max(float(before.max()), 1e-3)
    panels = [
        ("image 1", to_bytes(image1), None),
        ("image 2", to_bytes(image2), None),
        (f"flow; full colour: {scale:g} px; grey: unknown, {unknown:.0%}", flow_to_colour(known, scale), None),
        ("", to_bytes(image1), None),
        (f"|image 1 - image 2|, mean {255 * before.mean():.1f} of 255", before, limit),
        (f"|image 1 - warped image 2|, mean {255 * np.nanmean(after):.1f}", after, limit),
    ]
    for axis, (label, picture, top) in zip(axes.flat, panels, strict=True):
        axis.imshow(picture, cmap="gray", vmin=0, vmax=top, extent=(0, width, height, 0))
        axis.set_title(label, fontsize=10)
        axis.set_xticks([])
        axis.set_yticks([])
    inset = axes[0, 2].inset_axes((0.01, 0.76, 0.23 * height / width, 0.23))
    inset.imshow(legend(100))
    inset.axis("off")
    _quiver(axes[1, 0], known, scale)
    length = np.hypot(flow[..., 0], flow[..., 1])
    motion = f"mean motion {np.nanmean(length):.3g} px, largest {np.nanmax(length):.3g} px"
    figure.suptitle(f"{title}: {motion}", fontsize=11)
    with replacing(path) as temporary, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # a name in letters that the font lacks
        figure.savefig(temporary, format="png")


def _quiver(axis: "Axes", flow: FlowArray, scale: float) -> None:
    height, width = flow.shape[:2]
    step = max(1, width // 26)
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    factor = arrow_factor(scale)
    axis.quiver(
        columns + 0.5, rows + 0.5, flow[rows, columns, 0] * factor, flow[rows, columns, 1] * factor,
        angles="xy", scale_units="xy", scale=1, color="white", width=0.0035,
    )  # fmt: skip
    label = "arrows as long as the motion" if factor == 1 else f"arrows {factor:g} times the motion"
    axis.set_title(label, fontsize=10)
