"""One HTML file that needs nothing else: pictures inline as base64 PNG, films as WebP, arrows as SVG, no script."""

import base64
import io
from functools import cache
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.dataset.atomic_files import replace_file
from synth.dataset.images import encode_png
from synth.inspect.clips import pictures_of
from synth.inspect.inspection import Inspection
from synth.inspect.panels import CLOSURE_RANGE_PX, Arrows, Panel, Rgb, wheel_legend
from synth.inspect.text import COLUMNS, about_rows, facts
from synth.inspect.view import View

PAGE_MARK = "<title>synth: "
"""Text in each page's head, by which our pages are known."""
PICTURED = 24
"""Samples (and cameras) of a dataset that are shown with pictures, evenly spaced."""
QUALITY = 85
"""Of a film's compression, of 100."""

_STYLE = """
:root { color-scheme: light dark; --line: #8885; --soft: #8881; }
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 1500px; padding: 0 1.2rem; }
h1 { font-size: 1.5rem; margin: 0 0 .6rem; } h2 { font-size: 1.1rem; margin: 2.2rem 0 .6rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
td, th { padding: .18rem .7rem .18rem 0; text-align: left; vertical-align: top; }
th { font-weight: 600; white-space: nowrap; }
table.rows td, table.rows th { text-align: right; vertical-align: middle; white-space: nowrap; }
table.rows tr > * { border-bottom: 1px solid var(--line); }
table.rows td:first-child, table.rows th:first-child { text-align: left; }
.scroll { overflow-x: auto; }
.pictures { display: grid; grid-template-columns: repeat(auto-fill, minmax(270px, 1fr)); gap: 1rem; }
figure { margin: 0; } figure.film { grid-column: span 2; } figcaption { font-size: .85rem; padding: .25rem 0; }
.frame { position: relative; line-height: 0; border: 1px solid var(--line); }
.frame img.picture, .frame svg { width: 100%; image-rendering: pixelated; }
.frame svg { position: absolute; inset: 0; height: 100%; }
.frame .wheel { position: absolute; right: 2%; bottom: 2%; width: 17%; border-radius: 50%; }
details { margin-top: .8rem; } summary { cursor: pointer; }
p.note { color: #888; font-size: .85rem; max-width: 60rem; }
"""


def write_html(inspection: Inspection, html: Path | str) -> None:
    """Writes the page; a file of that name is replaced. InputError where a sample has gone or the storage refuses."""
    body = _dataset_body(inspection) if inspection.kind == "dataset" else _view_body(inspection)
    title = escape(inspection.path.resolve().name)
    page = (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">{PAGE_MARK}{title}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style></head>\n<body>\n{body}\n'
        f'<p class="note">{_NOTE}</p>\n</body></html>\n'
    )
    replace_file(Path(html), page.encode("utf-8"))


_NOTE = (
    "Flow: I1(x) = I2(x + forward(x)); U is right, V is down, px at pixel centres. Colours: direction is the hue, "
    "length the saturation, the wheel's rim the length given below the picture; longer is darker; grey sees no gel. "
    "Closure is |forward(x) + backward(x + forward(x))| by cubic interpolation between pixels, which is not exact at "
    f"kinks; its colours are logarithmic from {CLOSURE_RANGE_PX[0]:g} (dark) to {CLOSURE_RANGE_PX[1]:g} px (yellow). "
    "Differences are shares of full scale over visible pixels: blue below zero, red above, to the ± of the caption."
)


def _view_body(inspection: Inspection) -> str:
    parts = [f"<h1>{escape(str(inspection.path))}</h1>"]
    for number, numbers in enumerate(inspection.numbers):
        heading = f"<h2>{escape(numbers['name'])}</h2>" if number else ""
        parts += [heading, _facts(facts(numbers)), _pictures(inspection.view(number), numbers)]
    return "\n".join(parts)


def _dataset_body(inspection: Inspection) -> str:
    pictured = set(inspection.spread(PICTURED))
    rows, sections = [], []
    for number, numbers in enumerate(inspection.numbers):
        name, *cells = (escape(text(numbers)) for _, text in COLUMNS)
        rows.append(_cells("td", [f'<a href="#s{name}">{name}</a>' if number in pictured else name, *cells]))
        if number in pictured:
            sections.append(
                f'<h2 id="s{name}">Sample {name}</h2>\n{_pictures(inspection.view(number), numbers)}\n'
                f"<details><summary>all numbers</summary>{_facts(facts(numbers))}</details>"
            )
    heads = [name.replace("-\n", "") for name, _ in COLUMNS]
    some = f'<p class="note">{len(pictured)} of {len(rows)} samples have pictures.</p>'
    table = f'<table class="rows">{_cells("th", heads)}\n{"".join(rows)}</table>'
    return (
        f"<h1>{escape(str(inspection.path))}</h1>\n{_facts(about_rows(inspection))}\n<h2>Samples</h2>\n"
        f'{some if len(pictured) < len(rows) else ""}<div class="scroll">{table}</div>\n{"".join(sections)}'
    )


def _cells(tag: str, cells: list[str]) -> str:
    return "<tr>" + "".join(f"<{tag}>{cell}</{tag}>" for cell in cells) + "</tr>\n"


def _facts(rows: list[tuple[str, str]]) -> str:
    cells = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows)
    return f"<table>{cells}</table>"


def _pictures(view: View, numbers: dict[str, Any]) -> str:
    return f'<div class="pictures">{"".join(_figure(panel) for panel in pictures_of(view, numbers))}</div>'


def _figure(panel: Panel) -> str:
    caption = escape(panel.caption)
    wheel = _wheel() if panel.has_wheel else ""
    arrows = "" if panel.arrows is None else _arrows(panel.arrows, panel.picture.shape[1], panel.picture.shape[0])
    source = _inline(panel.picture) if panel.film is None else _inline_film(panel.film(), panel.rate)
    image = f'<img class="picture" alt="{caption}" src="{source}">'
    wide = "" if panel.film is None else ' class="film"'
    return f'<figure{wide}><div class="frame">{image}{arrows}{wheel}</div><figcaption>{caption}</figcaption></figure>\n'


def _arrows(arrows: Arrows, width: int, height: int) -> str:
    """Lines with a head, as one SVG path over the picture."""
    along = arrows.tip - arrows.start
    across = np.column_stack([-along[:, 1], along[:, 0]])
    barbs = [arrows.tip - 0.28 * along + side * 0.16 * across for side in (1, -1)]
    corners = np.stack([arrows.start, arrows.tip, barbs[0], arrows.tip, barbs[1]], axis=1).round(2)
    path = "".join("M" + "L".join(f"{x:g} {y:g}" for x, y in line) for line in corners)
    return (
        f'<svg viewBox="0 0 {width} {height}"><path d="{path}" fill="none" stroke="#b00020" '
        f'stroke-width="{width / 200:.3g}"/></svg>'
    )


def _inline(picture: NDArray[np.uint8]) -> str:
    return f"data:image/png;base64,{base64.b64encode(encode_png(picture)).decode('ascii')}"


def _inline_film(frames: list[Rgb], rate: float) -> str:
    """A moving picture that a page plays without a script."""
    from PIL import Image

    first, *others = map(Image.fromarray, frames)
    film, shown_ms = io.BytesIO(), round(1000 / rate)
    first.save(film, "WEBP", save_all=True, append_images=others, duration=shown_ms, loop=0, quality=QUALITY)
    return f"data:image/webp;base64,{base64.b64encode(film.getvalue()).decode('ascii')}"


@cache
def _wheel() -> str:
    """The legend, as an image; the style makes it round."""
    return f'<img class="wheel" alt="colour wheel" src="{_inline(wheel_legend(96)[..., :3])}">'
