"""Methods by the names that the command line knows."""

from collections.abc import Callable, Sequence

from gelflow.baselines.aldic import ALDIC
from gelflow.baselines.classical import DIS, TVL1, Farneback, NoMotion
from gelflow.baselines.lucas_kanade import LucasKanade
from gelflow.baselines.method import Method
from gelflow.errors import InputError

CLASSICAL: dict[str, Callable[[], Method]] = {
    "none": NoMotion,
    "lucas-kanade": LucasKanade,
    "farneback": Farneback,
    "dis-ultrafast": lambda: DIS("ultrafast"),
    "dis-fast": lambda: DIS("fast"),
    "dis-medium": lambda: DIS("medium"),
    "tvl1": TVL1,
}
"""Methods that need nothing but this package's requirements."""

OPTIONAL: dict[str, Callable[[], Method]] = {"al-dic": ALDIC}
"""Methods that need another package, which they name where it is missing."""


def named_methods(names: Sequence[str]) -> list[Method]:
    """Classical methods by name, in the given order.

    Raises:
        InputError: A name is not known, or is given twice.
    """
    known = CLASSICAL | OPTIONAL
    for name in names:
        if name not in known:
            raise InputError(f"there is no method {name!r}; allowed: {', '.join(known)}")
        if list(names).count(name) > 1:
            raise InputError(f"the method {name!r} is given twice")
    return [known[name]() for name in names]
