"""A PNG sheet: of a sample or flow file every picture large beside its numbers, of a dataset a row for each view.

Everything is drawn into one axes whose unit is an inch, with the origin in the upper left; an axes for each of a
dataset's 72 pictures would take several times as long.
"""

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from synth.dataset.atomic_files import replace_file
from synth.inspect.clips import pictures_of
from synth.inspect.inspection import Inspection
from synth.inspect.panels import Panel, wheel_legend
from synth.inspect.text import facts

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHEET_MARK = "synth inspect"
"""Software in each sheet's header."""
ROWS = 8
"""Rows on the sheet of a dataset, evenly spaced."""
_TOP, _MARGIN, _GAP = 0.4, 0.25, 0.1
"""Inches: room for the title, border, and space between pictures."""


def write_sheet(inspection: Inspection, png: Path | str) -> None:
    """Draws the sheet; a file of that name is replaced. InputError where a sample has gone or the storage refuses."""
    is_dataset = inspection.kind == "dataset"
    chosen = inspection.spread(ROWS) if is_dataset else list(range(len(inspection.places)))
    views = [inspection.view(number) for number in chosen]
    blocks = [pictures_of(view, inspection.numbers[number]) for number, view in zip(chosen, views, strict=True)]
    columns = max(map(len, blocks), default=0) if is_dataset else 3
    width, letters, beside = (2.75, 7.5, 0.0) if is_dataset else (4.2, 10.0, 4.0)
    caption = 0.03 * letters
    right = _MARGIN + columns * (width + _GAP)
    texts = [
        [] if is_dataset else [line for name, value in facts(inspection.numbers[k]) for line in (name, f"    {value}")]
        for k in chosen
    ]
    cells = [(width, width * view.size[0] / view.size[1]) for view in views]
    tall = [
        max(-(-len(panels) // columns) * (height + caption), 0.185 * len(lines))
        for panels, (_, height), lines in zip(blocks, cells, texts, strict=True)
    ]
    figure, axes = _empty_sheet(max(8.0, right + beside), max(1.0, _TOP + sum(tall) + _MARGIN))
    axes.text(_MARGIN, 0.1, _title(inspection), fontsize=12, va="top")
    top = _TOP
    for view, panels, cell, lines, tallness in zip(views, blocks, cells, texts, tall, strict=True):
        if len(views) > 1:
            axes.text(_MARGIN - 0.06, top + tallness / 2, view.name, fontsize=9, ha="right", va="center", rotation=90)
        for place, panel in enumerate(panels):
            row, column = divmod(place, columns)
            corner = (_MARGIN + column * (width + _GAP), top + row * (cell[1] + caption) + caption)
            _draw(axes, panel, corner, cell, letters)
        axes.text(right, top + caption, "\n".join(lines), va="top", fontsize=9.5, linespacing=1.3)
        top += tallness
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": SHEET_MARK})
    replace_file(Path(png), buffer.getvalue())


def _empty_sheet(width: float, height: float) -> "tuple[Figure, Axes]":
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=100)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(height, 0))
    axes.set_axis_off()
    axes.set_autoscale_on(False)
    return figure, axes


def _title(inspection: Inspection) -> str:
    if inspection.kind != "dataset":
        return str(inspection.path)
    about = inspection.about
    counts = f"{about['finished']} of {about['n']} samples"
    return f"{inspection.path}: {counts}, scene {about['scene']}, seed {about['seed']}"


def _draw(axes: "Axes", panel: Panel, corner: tuple[float, float], size: tuple[float, float], letters: float) -> None:
    """One picture with its caption, the colour wheel where it has one, and its arrows; lengths in inches."""
    (x, y), (width, height) = corner, size
    _picture(axes, panel.picture, x, y, width, height)
    frame_x, frame_y = x + width * np.array([0, 1, 1, 0, 0]), y + height * np.array([0, 0, 1, 1, 0])
    axes.plot(frame_x, frame_y, color="black", linewidth=0.6)
    axes.text(x + width / 2, y - 0.04, panel.caption, fontsize=letters, ha="center", va="bottom")
    if panel.has_wheel:
        side = 0.19 * width
        _picture(axes, wheel_legend(96), x + width - 1.06 * side, y + height - 1.06 * side, side, side)
    if panel.arrows is not None:
        inch = width / panel.picture.shape[1]
        along = inch * (panel.arrows.tip - panel.arrows.start)
        axes.quiver(
            *(inch * panel.arrows.start.T + np.array([[x], [y]])), *along.T, angles="xy", scale_units="xy", scale=1,
            color="#b00020", units="inches", width=0.006 * width, headwidth=3.6, headlength=4.5, headaxislength=4,
        )  # fmt: skip


def _picture(axes: "Axes", picture: np.ndarray, x: float, y: float, width: float, height: float) -> None:
    axes.imshow(picture, extent=(x, x + width, y + height, y), interpolation="nearest", aspect="auto")
