"""Looking at a dataset, a sample or one flow file: numbers, a PNG sheet, a self-contained HTML page."""

from synth.inspection.html import write_html
from synth.inspection.inspection import Inspection, inspect
from synth.inspection.sheet import write_sheet
from synth.inspection.table import tables

__all__ = ["Inspection", "inspect", "tables", "write_html", "write_sheet"]
