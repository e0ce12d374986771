"""Looking at a dataset, a sample or one flow file: numbers, a PNG sheet, a self-contained HTML page."""

from synth.inspection.html import PAGE_MARK, write_html
from synth.inspection.inspection import Inspection, inspect
from synth.inspection.sheet import SHEET_MARK, write_sheet
from synth.inspection.table import tables

__all__ = ["PAGE_MARK", "SHEET_MARK", "Inspection", "inspect", "tables", "write_html", "write_sheet"]
