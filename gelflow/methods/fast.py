"""The weights "fast": DIS, or the shipped network where DIS fails, then fast registration, then sigma, on a processor.

Nothing is learned for it. Against exact flow its error is mostly a quarter to a half of that of the best DIS preset,
and 1.4 to 3 times that of the network. Where marks move by half their distance or more, DIS loses them, and the network
is asked for a start (`gelflow.fast.start`); it is loaded then.
"""

from pathlib import Path

from gelflow.arrays import Estimate, FlowArray, ImageArray
from gelflow.errors import InputError
from gelflow.fast.certainty import refined
from gelflow.fast.registration import STAGES, Prepared, register
from gelflow.fast.start import fresh_start
from gelflow.files.image import check_images
from gelflow.methods.name import MethodName

FAST = "fast"
"""Its name where weights are named."""


class Fast:
    """A method (`gelflow.methods.method.Method`) that also says how certain its flow is."""

    name = MethodName(FAST)
    device = "cpu"

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """See `Method.flow`."""
        return self.estimate(image1, image2).flow

    def estimate(self, image1: ImageArray, image2: ImageArray) -> Estimate:
        """The flow and how certain it is; arguments and exceptions as for `flow`.

        Images of more than 400 x 300 px are reduced to as many pixels as 320 x 240 have.
        """
        check_images(image1, image2)
        first, second = Prepared(image1), Prepared(image2)
        flow = register(fresh_start(first, second), first, second, STAGES[1:])
        return refined(flow, first, second).estimate(first)


def is_fast(path: Path) -> bool:
    """Whether weights are "fast", and no file of that name."""
    return str(path) == FAST and not path.is_file()


def fast(size: tuple[int, int] | None, device: str, registration: str | None) -> Fast:
    """The method; InputError for what is an option of networks alone."""
    if size is not None or registration is not None or device == "cuda":
        raise InputError(f"{FAST}: takes no size and no registration, and computes on the processor alone")
    return Fast()
