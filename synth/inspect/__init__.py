"""Looking at a dataset, a sample or one flow file: numbers, a PNG sheet, a self-contained HTML page."""

from synth.inspect.html import PAGE_MARK, write_html
from synth.inspect.inspection import inspect
from synth.inspect.sheet import SHEET_MARK, write_sheet
from synth.inspect.text import tables

__all__ = ["PAGE_MARK", "SHEET_MARK", "inspect", "tables", "write_html", "write_sheet"]
