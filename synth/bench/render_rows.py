"""Rows of `bench render` as CSV, a file for each part, written whole again with every row."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from synth.bench.render_auto import Choice
from synth.bench.render_flow import Effect
from synth.bench.render_measure import Cell
from synth.dataset.storage import replace_file

IMAGE_FILE, FLOW_FILE, AUTO_FILE = "render.csv", "render_flow.csv", "render_auto.csv"


def cell_row(cell: Cell) -> dict[str, Any]:
    """Of a setting; `is_error` is False where the picture is another one (no window)."""
    setting = cell.setting
    return {
        "variant": setting.variant.name,
        "window": setting.window,
        "max_depth": setting.max_depth,
        "samples": setting.samples,
        "seconds": round(cell.seconds, 5),
        "processor_s": round(cell.processor_s, 5),
        "is_error": cell.is_error,
        **{name: round(value, 6) for name, value in vars(cell.errors).items()},
    }


def effect_rows(effect: Effect) -> list[dict[str, Any]]:
    """A row for each pair."""
    seeds = range(len(effect.error_px))
    return [
        {
            "samples": effect.samples,
            "camera_noise": effect.camera_noise,
            "first": i,
            "second": j,
            "error_px": round(float(effect.error_px[i, j]), 6),
            "change_px": round(float(effect.change_px[i, j]), 6),
            "typical_px": round(float(effect.typical_px[i, j]), 6),
            "typical_change_px": round(float(effect.typical_change_px[i, j]), 6),
            "difference_px": round(float(effect.difference_px[i, j]), 6),
        }
        for i in seeds
        for j in seeds
    ]


def effect_record(effect: Effect) -> dict[str, Any]:
    """All pairs together."""
    (change, error), (typical, typical_error) = effect.change, effect.typical_change
    return {
        "samples": effect.samples,
        "camera_noise": effect.camera_noise,
        "error_px": round(effect.median_px, 6),
        "change_px": round(change, 6),
        "change_se_px": round(error, 6),
        "typical_px": round(float(np.median(effect.typical_px)), 6),
        "typical_change_px": round(typical, 6),
        "typical_change_se_px": round(typical_error, 6),
        "difference_px": round(effect.median_difference_px, 6),
    }


def choice_row(choice: Choice) -> dict[str, Any]:
    """Of a sensor."""
    row = {name: round(value, 5) if isinstance(value, float) else value for name, value in vars(choice).items()}
    return {**row, "share": round(choice.share, 5)}


def write_rows(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """All rows so far; none: no file.

    Raises:
        InputError: the storage refuses; what was there before is still there.
    """
    if not rows:
        return
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    replace_file(path, text.getvalue().encode("utf-8"))
