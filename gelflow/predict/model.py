"""The network of the public Python interface: flow between two images, as arrays or as tensors."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gelflow.arrays import Bytes3, Estimate, Flow, FlowArray, ImageArray, Images
from gelflow.config import Registration
from gelflow.errors import InputError
from gelflow.files.image import THREE_OF, as_image, check_range, full_range, range_factor
from gelflow.methods.fast import Fast, fast, is_fast
from gelflow.methods.learned import Learned
from gelflow.methods.method import estimated
from gelflow.models.estimate import estimate_flow
from gelflow.models.weights import SHIPPED, weights_file


class FlowModel:
    """A trained GelFlow network, or the method "fast"; `load_model` makes one."""

    def __init__(self, network: Learned | Fast) -> None:
        self._network = network

    @property
    def device(self) -> str:
        """Where it computes, "cpu" or "cuda"."""
        return self._network.device

    @overload
    def flow(self, image1: ImageArray | Bytes3, image2: ImageArray | Bytes3) -> FlowArray: ...
    @overload
    def flow(self, image1: Images, image2: Images) -> Flow: ...
    def flow(self, image1: ImageArray | Bytes3 | Images, image2: ImageArray | Bytes3 | Images) -> FlowArray | Flow:
        """Estimates the motion from image 1 to image 2, at their own size.

        Args:
            image1: An array (H, W, 3), uint8, uint16 or float in [0, 1]; or a tensor (3, H, W) in [0, 1], on any
                device. Each side has 16 px or more. Images may be grey, with one channel or no axis for it, or RGBA,
                whose alpha is left out. Batches have one axis more in front.
            image2: The same kind and shape.

        Returns:
            Flow in px, U right and V down, ``I1(x) = I2(x + flow(x))`` at pixel centres (c + 0.5, r + 0.5). Of arrays
            (H, W, 2) float32; of tensors (2, H, W) float32 on their device, without gradient. Of batches (B, H, W, 2)
            or (B, 2, H, W). Images that fill a small part of the range are scaled, with a warning.

        Raises:
            InputError: Other kinds, shapes or values, or an array beside a tensor.

        Examples:
            >>> import gelflow, numpy as np
            >>> image1 = np.random.default_rng(0).integers(0, 256, (64, 80, 3), np.uint8)
            >>> gelflow.load_model("best").flow(image1, np.roll(image1, 1, axis=1)).shape
            (64, 80, 2)
        """
        if isinstance(image1, Tensor) and isinstance(image2, Tensor):
            if image1.ndim == image2.ndim == 2:
                return self.flow(image1[None], image2[None])
            if image1.ndim == image2.ndim == 3:
                return self.flow(image1[None], image2[None])[0]
            if not image1.numel() or not image2.numel():
                raise InputError("no image given: the batch is empty")
            first, second = (
                image[:, THREE_OF[image.shape[1]]] if image.ndim == 4 and image.shape[1] in THREE_OF else image
                for image in (image1, image2)
            )
            brightest = 0.0
            for name, image in (("image 1", first), ("image 2", second)):
                least, most = torch.stack([image.min(), image.max()]).tolist()  # a device is waited for once
                check_range(name, str(image.dtype), least, most)
                brightest = max(brightest, most)
            factor = range_factor(brightest)
            if isinstance(self._network, Fast):
                arrays = zip(*(image.movedim(1, -1).float().cpu().numpy() for image in (first, second)), strict=True)
                flows = [self._network.flow(factor * one, factor * other) for one, other in arrays]
                return torch.from_numpy(np.stack(flows)).movedim(-1, 1).to(image1.device)
            network = self._network
            return estimate_flow(network.model, factor * first, factor * second, network.size, network.run)
        if isinstance(image1, np.ndarray) and isinstance(image2, np.ndarray):
            if image1.ndim == image2.ndim == 4:
                return np.stack([self.flow(*each) for each in _pairs(image1, image2)])
            return self._network.flow(*_images(image1, image2))
        given = f"{type(image1).__name__} and {type(image2).__name__}"
        raise InputError(f"images of {given}: two NumPy arrays or two torch tensors are needed")

    def estimate(self, image1: ImageArray | Bytes3, image2: ImageArray | Bytes3) -> Estimate:
        """The flow of two arrays, as `flow` gives it, and how certain it is; see `gelflow.models.uncertainty`.

        Of batches, all three have an axis more in front. InputError as for `flow`, and for tensors.
        """
        if isinstance(image1, Tensor):
            raise InputError("estimate takes arrays; of a tensor (3, H, W) give tensor.movedim(0, -1).numpy()")
        if image1.ndim == image2.ndim == 4:
            found = [self.estimate(*each) for each in _pairs(image1, image2)]
            return Estimate(*map(np.stack, zip(*found, strict=True)))
        return estimated(self._network, *_images(image1, image2))[0]


def load_model(
    name_or_path: str | Path = SHIPPED,
    device: str = "auto",
    registration: Registration | None = None,
    size: tuple[int, int] | None = None,
) -> FlowModel:
    """Loads a trained network, or the method that needs none.

    Args:
        name_or_path: "best", the weights that come with the package; a file that `gelflow train` or `finetune` wrote
            (weights.safetensors); or "fast", DIS with fast registration on the processor, which takes a seventh of
            the time, or half where it asks the network of "best" for a start (see `gelflow.methods.fast`).
        device: "cpu", "cuda", or "auto", a CUDA device where there is one.
        registration: "none", "motion", "both" or "brightness": how the flow is corrected on the images; None: what the
            weights ask for, which is "motion" for "best".
        size: Rows and columns at which the network works; None: those of its training or, where it had none, of the
            images, of which those of more than 400 x 300 px are reduced to two sizes.

    Raises:
        InputError: No such file, a damaged one or another network's, no such device, or no such registration or size;
            of "fast", a CUDA device and any registration or size.
    """
    if size is not None and (len(size) != 2 or not all(isinstance(side, int) for side in size)):
        raise InputError(f"size = {size!r}: rows and columns are needed, such as (240, 320)")
    path = weights_file(Path(name_or_path))
    if is_fast(path):
        return FlowModel(fast(size, device, registration))
    return FlowModel(Learned(path, None, size, device, registration))


def _pairs(image1: NDArray[np.generic], image2: NDArray[np.generic]) -> Iterator[Any]:
    """The pairs of two batches of arrays."""
    if not 0 < len(image1) == len(image2):
        raise InputError(f"batches of {len(image1)} and {len(image2)} images; give as many of both, and at least one")
    return zip(image1, image2, strict=True)


def _images(image1: NDArray[np.generic], image2: NDArray[np.generic]) -> tuple[ImageArray, ImageArray]:
    """Two arrays as images are in memory."""
    return full_range(as_image("image 1", image1), as_image("image 2", image2))
