"""Numbers as the report of the error budget writes them."""

import math
from collections.abc import Sequence


def number(value: float) -> str:
    """Two digits, or a dash for what there is no number of."""
    return "–" if math.isnan(value) else f"{value:.2g}" if value < 10 else f"{value:.0f}"


def share(count: int, of: int) -> str:
    """A count, and what it is in %."""
    return f"{count} of {of} ({100 * count / of:.0f} %)" if of else "–"


def span(values: Sequence[float]) -> str:
    """Smallest and largest."""
    low, high = min(values), max(values)
    return f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"


def cell(text: str) -> str:
    """What fits a cell of a Markdown table."""
    return text.replace("|", "/").replace("\n", " ")
