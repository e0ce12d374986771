"""Methods by the names that the command line knows."""

from collections.abc import Callable, Sequence

from gelflow.baselines.classical import DIS, TVL1, Farneback, NoMotion
from gelflow.baselines.method import Method
from gelflow.errors import InputError

CLASSICAL: dict[str, Callable[[], Method]] = {
    "none": NoMotion,
    "farneback": Farneback,
    "dis-ultrafast": lambda: DIS("ultrafast"),
    "dis-fast": lambda: DIS("fast"),
    "dis-medium": lambda: DIS("medium"),
    "tvl1": TVL1,
}


def named_methods(names: Sequence[str]) -> list[Method]:
    """Classical methods by name, in the given order.

    Raises:
        InputError: A name is not known, or is given twice.
    """
    for name in names:
        if name not in CLASSICAL:
            raise InputError(f"there is no method {name!r}; allowed: {', '.join(CLASSICAL)}")
        if list(names).count(name) > 1:
            raise InputError(f"the method {name!r} is given twice")
    return [CLASSICAL[name]() for name in names]
