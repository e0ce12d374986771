"""Numbers as short text, the rows and columns that table, sheet and page show, and the tables for the terminal."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rich.cells import cell_len
from rich.table import Table
from rich.text import Text

from synth.errors import printable
from synth.inspect.inspection import Inspection

NONE = "–"
Column = tuple[str, list[str]]
"""Heading of a table, and a cell for each sample."""


def short(value: object) -> str:
    """A number to three digits, a truth as yes or no, nothing as a dash."""
    if value is None:
        return NONE
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def percent(share: float | None) -> str:
    return NONE if share is None else f"{100 * share:.4g} %"


def vector(values: Sequence[float]) -> str:
    return f"({', '.join(f'{value:.3g}' for value in values)})"


def facts(numbers: Mapping[str, Any]) -> list[tuple[str, str]]:
    """(name, value) of all that `numbers_of` found."""
    bits = "" if numbers["bits"] is None else f", {numbers['bits']} bits"
    rows = [("size", f"{numbers['width']} x {numbers['height']} px{bits}")]
    if numbers["frames"] is not None and numbers["trajectory"] is not None:
        frames = numbers["frames"]
        rows.append(
            ("trajectory, frames", f"{numbers['trajectory']}, {frames if isinstance(frames, str) else vector(frames)}")
        )
    for direction in ("forward", "backward"):
        motion = numbers[direction]
        if motion is None:
            rows.append((direction, "not in the file"))
            continue
        lengths = " / ".join(short(motion[key]) for key in ("min_px", "median_px", "p95_px", "max_px"))
        rows.append((f"{direction} min / median / 95 % / max", f"{lengths} px"))
        rows.append(
            (f"{direction} without gel, visible", f"{percent(motion['nan_share'])}, {percent(motion['visible_share'])}")
        )
    for key, name in (("closure", "closure (interpolated)"), ("sigma", "sigma of the estimate")):
        if (found := numbers[key]) is not None:
            lengths = " / ".join(short(found[part]) for part in ("median_px", "p95_px", "max_px"))
            rows.append((f"{name} median / 95 % / max", f"{lengths} px"))
    difference = numbers["difference"]
    if difference is not None:
        before, after = difference["before_rmse"], difference["after_rmse"]
        rows.append(
            ("image difference (RMS) before, after warping", f"{percent(before)}, {percent(after)} of full scale")
        )
    rows += _states(numbers)
    if numbers["channels"]:
        rows.append(("other channels", ", ".join(numbers["channels"])))
    return rows


def _states(numbers: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Forces and solver diagnostics, both frames in one value."""
    rows = []
    for key, name, unit in (("force_n", "force", "N"), ("torque_nmm", "torque", "N mm")):
        if numbers[key] is not None:
            rows.append((f"{name} in frames 1, 2", "; ".join(vector(row) for row in numbers[key]) + f" {unit}"))
    for part in ("normal", "side") if numbers["force_n"] is not None else ():
        rows.append((f"{part} force in frames 1, 2", "; ".join(map(short, numbers[f"{part}_force_n"])) + " N"))
    for name in _SOLVER if numbers["solver"] else ():
        values = [state.get(name) for state in numbers["solver"] if isinstance(state, dict)]
        if any(value is not None for value in values):
            shown = (vector(value) if isinstance(value, list) else short(value) for value in values)
            rows.append((name.replace("_", " "), "; ".join(shown)))
    return rows


_SOLVER = (
    "depth_mm", "shear_mm", "twist_deg", "converged", "newton_iterations", "residual", "min_jacobian",
    "max_penetration_mm",
)  # fmt: skip


def about_rows(inspection: Inspection) -> list[tuple[str, str]]:
    about = inspection.about
    seconds = ", ".join(f"{stage} {value:.3g} s" for stage, value in about["seconds"].items())
    shown = "" if about["inspected"] == about["finished"] else f" ({about['inspected']} of them looked at)"
    return [
        ("scene, seed", f"{about['scene']}, {about['seed']}"),
        ("finished samples", f"{about['finished']} of {about['n']}{shown}"),
        ("failed attempts", str(about["failed_draws"])),
        ("device", ", ".join(f"{key} {value}" for key, value in about["device"].items()) or "not recorded"),
        ("software", ", ".join(f"{key} {value}" for key, value in about["software"].items()) or "not recorded"),
        ("time", seconds or "not recorded"),
    ]


def _solver(numbers: dict[str, Any]) -> dict[str, Any]:
    return numbers["solver"][-1] if numbers["solver"] else {}


COLUMNS: tuple[tuple[str, Callable[[dict[str, Any]], str]], ...] = (
    ("sample", lambda n: n["name"]),
    ("size\npx", lambda n: f"{n['width']}x{n['height']}"),
    ("frames", lambda n: "-".join(str(frame) for frame in n["frames"])),
    ("depth\nmm", lambda n: short(_solver(n).get("depth_mm"))),
    ("Fn\nN", lambda n: short(n["normal_force_n"][1])),
    ("flow\nmedian, px", lambda n: short(n["forward"]["median_px"])),
    ("flow\n95 %, px", lambda n: short(n["forward"]["p95_px"])),
    ("flow\nmax, px", lambda n: short(n["forward"]["max_px"])),
    ("no gel", lambda n: percent(n["forward"]["nan_share"])),
    ("visible", lambda n: percent(n["forward"]["visible_share"])),
    ("closure\n95 %, px", lambda n: short((n["closure"] or {}).get("p95_px"))),
    ("difference\nbefore", lambda n: percent((n["difference"] or {}).get("before_rmse"))),
    ("difference\nwarped", lambda n: percent((n["difference"] or {}).get("after_rmse"))),
    ("con-\nverged", lambda n: short(_solver(n).get("converged"))),
)
"""Columns of the table of samples: the heading, and the cell from a sample's numbers."""


def tables(inspection: Inspection, width: int | None = None) -> list[Table]:
    """Tables for the terminal: of a dataset its facts and a row per sample and camera, else all numbers.

    Columns that do not fit the terminal's width in characters, where one is given, follow in further tables.
    """
    if inspection.kind != "dataset":
        return [_pairs(str(place), facts(n)) for place, n in zip(inspection.places, inspection.numbers, strict=True)]
    columns = [(name, [text(numbers) for numbers in inspection.numbers]) for name, text in COLUMNS]
    return [
        _pairs(str(inspection.path), about_rows(inspection)),
        *(_samples(part) for part in _fitting(columns, width)),
    ]


def _fitting(columns: list[Column], width: int | None) -> list[list[Column]]:
    """The columns in parts that fit; each begins with the first column, which names the sample."""
    parts = [columns[:1]]
    for column in columns[1:]:
        if width is not None and len(parts[-1]) > 1 and _width([*parts[-1], column]) > width:
            parts.append(columns[:1])
        parts[-1] = [*parts[-1], column]
    return parts


def _width(columns: list[Column]) -> int:
    """Characters of a table: two of padding and a border for each column, and the last border."""
    lines = [[*name.splitlines(), *cells] for name, cells in columns]
    return 1 + sum(3 + max(cell_len(line) for line in column) for column in lines)


def _samples(columns: list[Column]) -> Table:
    rows = Table(title="samples", title_justify="left", header_style="bold")
    for name, _ in columns:
        rows.add_column(name, justify="right", overflow="fold")
    for cells in zip(*(cells for _, cells in columns), strict=True):
        rows.add_row(*map(Text, map(printable, cells)))
    return rows


def _pairs(title: str, rows: list[tuple[str, str]]) -> Table:
    table = Table(title=Text(printable(title), style="table.title"), title_justify="left", show_header=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(name, Text(printable(value)))
    return table
