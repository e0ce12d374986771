"""Methods by the names that the command line knows."""

from collections.abc import Sequence

from gelflow.baselines.aldic import ALDIC
from gelflow.baselines.classical import FARNEBACK, NO_MOTION, TVL1, RegisteredDIS, dis
from gelflow.baselines.exact import ExactFlow
from gelflow.baselines.lucas_kanade import LucasKanade
from gelflow.config import REGISTRATIONS
from gelflow.errors import InputError
from gelflow.hardware import chosen_device
from gelflow.methods.method import Method

CLASSICAL: dict[str, Method] = {
    "none": NO_MOTION,
    "lucas-kanade": LucasKanade(),
    "farneback": FARNEBACK,
    "dis-ultrafast": dis("ultrafast"),
    "dis-fast": dis("fast"),
    "dis-medium": dis("medium"),
    "tvl1": TVL1,
}
"""The paper's methods that need no training, and no motion."""

BESIDE: dict[str, Method] = {"al-dic": ALDIC(), "exact": ExactFlow()}
"""Methods that the paper does not have: pyALDIC, another package that is named where it is missing, and the answer
itself, where the data have it."""

REGISTERED = {f"dis-{aim}": (aim, settings) for aim, settings in REGISTRATIONS.items() if settings is not None}
"""DIS medium with this project's registration, which may run on a device; not in the paper."""


def named_methods(names: Sequence[str], device: str = "cpu") -> list[Method]:
    """Methods without weights by their keys in `CLASSICAL`, `BESIDE` and `REGISTERED`, in the given order.

    The device, "auto", "cpu" or "cuda", is for what can run on another than the processor. InputError where a name is
    not known, or is given twice, or the device is not there.
    """
    known = [*CLASSICAL, *REGISTERED, *BESIDE]
    for name in names:
        if name not in known:
            raise InputError(f"there is no method {name!r}; allowed: {', '.join(known[:-1])}; in compare, exact")
        if list(names).count(name) > 1:
            raise InputError(f"the method {name!r} is given twice")
    plain = CLASSICAL | BESIDE
    return [plain[name] if name in plain else RegisteredDIS(*REGISTERED[name], chosen_device(device)) for name in names]
