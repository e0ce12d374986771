"""Real and synthetic frames on one sheet, shuffled, and their statistics side by side.

    python -m synth.calibrate.blind --real FRAME... --synthetic FRAME... --out DIR

writes DIR/blind.png, numbered frames in random order; DIR/key.txt, which of them are real; DIR/statistics.md.
Recordings are their owners': the sheet goes where its maker says, and not into this repository.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import App, CycloptsError, Parameter

from synth.arrays import FloatArray
from synth.errors import InputError

STATISTICS = {
    "mean red": "levels of 255", "mean green": "levels", "mean blue": "levels",
    "red, right less left": "thirds of the image, levels", "green, right less left": "levels",
    "blue, right less left": "levels", "red, bottom less top": "levels", "green, bottom less top": "levels",
    "blue, bottom less top": "levels", "corners over middle": "linear brightness",
    "dots over coating": "linear brightness of the darkest 2 % over that around",
    "fine detail red": "standard deviation behind Immerkær's kernel, off the dots, levels",
    "fine detail green": "levels", "fine detail blue": "levels",
}  # fmt: skip
"""Name and what it is."""
_KERNEL = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0]) / 6
_CLIP = 4.0
"""Fine detail beyond so many levels is an edge, not noise."""


def statistics(image: FloatArray, gamma: float = 2.2) -> FloatArray:
    """The numbers of STATISTICS, in its order, of a frame (H, W, 3) RGB in levels of 255."""
    import cv2

    height, width = image.shape[:2]
    window = 2 * (max(height, width) // 20) + 1
    smooth = cv2.medianBlur(np.clip(np.round(image), 0, 255).astype(np.uint8), window).astype(np.float64)
    linear, around = ((part.mean(axis=2) / 255) ** gamma for part in (image, smooth))
    ratio = linear / np.maximum(around, 1e-4)
    bare = cv2.erode((ratio > 0.8).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    third_x, third_y, corner = width // 3, height // 3, min(height, width) // 6
    across = smooth[:, -third_x:].mean(axis=(0, 1)) - smooth[:, :third_x].mean(axis=(0, 1))
    down = smooth[-third_y:].mean(axis=(0, 1)) - smooth[:third_y].mean(axis=(0, 1))
    corners = [
        around[r, c].mean()
        for r in (slice(corner), slice(-corner, None))
        for c in (slice(corner), slice(-corner, None))
    ]
    middle = around[third_y:-third_y, third_x:-third_x].mean()
    fine = [
        np.clip(cv2.filter2D(channel, -1, _KERNEL)[bare], -_CLIP, _CLIP).std() for channel in np.moveaxis(image, 2, 0)
    ]
    dark = np.percentile(ratio, 2)
    return np.array([*smooth.mean(axis=(0, 1)), *across, *down, np.mean(corners) / middle, dark, *fine])


def table(real: Sequence[FloatArray], synthetic: Sequence[FloatArray]) -> str:
    """A Markdown table: mean and standard deviation over the frames of each kind."""
    kinds = [np.array([statistics(image) for image in images]) for images in (real, synthetic)]
    lines = ["| | real | synthetic | what |", "| --- | ---: | ---: | --- |"]
    for k, (name, what) in enumerate(STATISTICS.items()):
        cells = [f"{kind[:, k].mean():.2f} ± {kind[:, k].std():.2f}" for kind in kinds]
        lines.append(f"| {name} | {cells[0]} | {cells[1]} | {what} |")
    return "\n".join(lines) + "\n"


def write_sheet(real: Sequence[Path], synthetic: Sequence[Path], out: Path, seed: int) -> None:
    """See the module.

    Raises:
        InputError: a file is missing or no image, or the storage refuses.
    """
    import io

    from matplotlib.figure import Figure

    from synth.calibrate.frames import read_frames
    from synth.dataset.storage import replace_file, storage_errors

    images = [255 * read_frames([path]).encoded for path in (*real, *synthetic)]
    order = np.random.default_rng(seed).permutation(len(images))
    rows = -(-len(images) // 4)
    figure = Figure(figsize=(12.8, 2.6 * rows), dpi=100)
    axes = figure.subplots(rows, 4, squeeze=False).ravel()
    for axis in axes:
        axis.set_axis_off()
    for number, (axis, k) in enumerate(zip(axes, order, strict=False), 1):
        axis.imshow(np.clip(images[k] / 255, 0, 1))
        axis.set_title(str(number), fontsize=9)
    figure.tight_layout()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    key = "".join(f"{number}: {'real' if k < len(real) else 'synthetic'}\n" for number, k in enumerate(order, 1))
    with storage_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    replace_file(out / "blind.png", buffer.getvalue())
    replace_file(out / "key.txt", key.encode())
    replace_file(out / "statistics.md", table(images[: len(real)], images[len(real) :]).encode())


app = App(name="blind", help="Real and synthetic frames on one shuffled sheet, and their statistics.")


@app.default
def blind(
    *,
    real: Annotated[list[Path], Parameter(consume_multiple=True, help="Frames of the real sensor.")],
    synthetic: Annotated[list[Path], Parameter(consume_multiple=True, help="Rendered frames.")],
    out: Annotated[Path, Parameter(help="Directory for blind.png, key.txt and statistics.md.")],
    seed: Annotated[int, Parameter(help="Of the order.")] = 0,
) -> None:
    """Writes the sheet."""
    write_sheet(real, synthetic, out, seed)
    print(out / "blind.png")


if __name__ == "__main__":
    try:
        app(exit_on_error=False)
    except (InputError, CycloptsError) as error:
        print(f"synth: {error}", file=sys.stderr)
        sys.exit(2)
