"""A PNG sheet: of a sample or flow file every picture large, of a dataset a row of pictures per sample and camera.

Everything is drawn into one axes whose unit is an inch, with the origin in the upper left; an axes for each of a
dataset's 72 pictures would take several times as long.
"""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from synth.dataset.storage import replace_file
from synth.inspection.inspection import Inspection
from synth.inspection.panels import CLOSURE_MAP, CLOSURE_RANGE_PX, Panel, panels_of
from synth.inspection.text import facts
from synth.inspection.wheel import wheel_legend

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHEET_MARK = "synth inspect"
"""Software in each sheet's header."""
ROWS = 8
"""Rows on the sheet of a dataset, evenly spaced."""
_DPI = 100
_COLUMNS = 3
_TOP, _MARGIN, _GAP = 0.4, 0.12, 0.1
"""Inches: room for the title, border, and space between pictures."""


@dataclass(frozen=True)
class _Cell:
    """Place of a picture in inches, and the size of its caption's letters in points."""

    x: float
    y: float
    width: float
    height: float
    letters: float


def write_sheet(inspection: Inspection, png: Path | str) -> None:
    """Draws the sheet; a file of that name is replaced.

    Raises:
        InputError: A sample's file has gone or is damaged, or the storage refuses.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(dpi=_DPI)
    canvas = FigureCanvasAgg(figure)
    if inspection.kind == "dataset":
        _draw_dataset(figure, inspection)
    else:
        _draw_view(figure, inspection)
    buffer = io.BytesIO()
    canvas.print_png(buffer, metadata={"Software": SHEET_MARK})
    replace_file(Path(png), buffer.getvalue())


def _draw_view(figure: "Figure", inspection: Inspection) -> None:
    """Pictures in three columns, all numbers to the right; a block of both for each camera."""
    width, caption, beside = 4.2, 0.3, 4.0
    right = _MARGIN + _COLUMNS * (width + _GAP)
    views = [inspection.view(number) for number in range(len(inspection.places))]
    blocks = [panels_of(view, numbers) for view, numbers in zip(views, inspection.numbers, strict=True)]
    texts = [[line for name, value in facts(n) for line in (name, f"    {value}")] for n in inspection.numbers]
    heights = [width * view.size[0] / view.size[1] for view in views]
    tall = [
        max(-(-len(panels) // _COLUMNS) * (height + caption), 0.185 * len(lines))
        for panels, height, lines in zip(blocks, heights, texts, strict=True)
    ]
    axes = _page(figure, right + beside, _TOP + sum(tall) + _MARGIN, str(inspection.path))
    top = _TOP
    for number, panels in enumerate(blocks):
        for place, panel in enumerate(panels):
            row, column = divmod(place, _COLUMNS)
            x, y = _MARGIN + column * (width + _GAP), top + row * (heights[number] + caption) + caption
            _draw(axes, panel, _Cell(x, y, width, heights[number], letters=10))
        named = [views[number].name, *texts[number]] if len(views) > 1 else texts[number]
        axes.text(right + _GAP, top + caption, "\n".join(named), va="top", fontsize=9.5, linespacing=1.3)
        top += tall[number]


def _draw_dataset(figure: "Figure", inspection: Inspection) -> None:
    """A row per sample and camera, a column per picture."""
    about = inspection.about
    title = f"{inspection.path}: {about['finished']} of {about['n']} samples"
    title += f", scene {about['scene']}, seed {about['seed']}"
    chosen = inspection.spread(ROWS)
    if not chosen:
        _page(figure, 8.0, 1.0, title)
        return
    views = [inspection.view(number) for number in chosen]
    lines = [panels_of(view, inspection.numbers[number]) for number, view in zip(chosen, views, strict=True)]
    names = [panel.name for panel in max(lines, key=lambda panels: len(panels))]
    width, caption, left = 2.75, 0.2, 0.25
    height = width * max(view.size[0] / view.size[1] for view in views)
    size = (left + len(names) * (width + _GAP) + _MARGIN, _TOP + len(views) * (height + caption) + _MARGIN)
    axes = _page(figure, *size, title)
    for row, (view, panels) in enumerate(zip(views, lines, strict=True)):
        y = _TOP + row * (height + caption) + caption
        axes.text(left - 0.06, y + height / 2, view.name, fontsize=9, ha="right", va="center", rotation=90)
        for panel in panels:
            x = left + names.index(panel.name) * (width + _GAP)
            shape = view.size[0] / view.size[1]
            _draw(axes, panel, _Cell(x, y, width, width * shape, letters=7.5))


def _page(figure: "Figure", width: float, height: float, title: str) -> "Axes":
    figure.set_size_inches(width, height)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.text(_MARGIN, 0.1, title, fontsize=12, va="top")
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    axes.set_autoscale_on(False)
    return axes


def _draw(axes: "Axes", panel: Panel, cell: _Cell) -> None:
    """One picture with its caption and whatever explains it."""
    _picture(axes, panel.picture, cell.x, cell.y, cell.width, cell.height)
    frame_x = cell.x + cell.width * np.array([0, 1, 1, 0, 0])
    axes.plot(frame_x, cell.y + cell.height * np.array([0, 0, 1, 1, 0]), color="black", linewidth=0.6)
    axes.text(cell.x + cell.width / 2, cell.y - 0.04, panel.caption, fontsize=cell.letters, ha="center", va="bottom")
    if panel.scale == "wheel":
        side = 0.19 * cell.width
        x, y = cell.x + cell.width - 1.06 * side, cell.y + cell.height - 1.06 * side
        _picture(axes, wheel_legend(96), x, y, side, side)
    if panel.scale == "closure":
        _closure_bar(axes, cell)
    if panel.arrows is not None:
        inch = cell.width / panel.picture.shape[1]
        along = inch * (panel.arrows.tip - panel.arrows.start)
        x, y = inch * panel.arrows.start.T + np.array([[cell.x], [cell.y]])
        axes.quiver(
            x, y, *along.T, angles="xy", scale_units="xy", scale=1, color="#b00020", units="inches",
            width=0.006 * cell.width, headwidth=3.6, headlength=4.5, headaxislength=4,
        )  # fmt: skip


def _picture(axes: "Axes", picture: np.ndarray, x: float, y: float, width: float, height: float) -> None:
    axes.imshow(picture, extent=(x, x + width, y + height, y), interpolation="nearest", aspect="auto")


def _closure_bar(axes: "Axes", cell: _Cell) -> None:
    """The colour scale over the picture's lower edge."""
    import matplotlib

    x, width = cell.x + 0.08 * cell.width, 0.84 * cell.width
    y, height = cell.y + 0.84 * cell.height, 0.04 * cell.height
    _picture(axes, matplotlib.colormaps[CLOSURE_MAP](np.linspace(0, 1, 256))[None, :, :3], x, y, width, height)
    axes.plot(x + width * np.array([0, 1, 1, 0, 0]), y + height * np.array([0, 0, 1, 1, 0]), "white", linewidth=0.6)
    low, high = (round(float(np.log10(end))) for end in CLOSURE_RANGE_PX)
    style: dict[str, Any] = {"color": "white", "ha": "center"}
    for exponent in range(low, high + 1):
        tick = x + width * (exponent - low) / (high - low)
        axes.text(tick, y + 1.3 * height, f"$10^{{{exponent}}}$", fontsize=0.8 * cell.letters, va="top", **style)
    axes.text(x + width / 2, y - 0.02, "px, logarithmic", fontsize=0.8 * cell.letters, va="bottom", **style)
