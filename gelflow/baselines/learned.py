"""A trained GelFlow network behind the interface of all methods."""

from pathlib import Path
from typing import Any

import numpy as np

from gelflow.baselines.method import check_images
from gelflow.errors import InputError
from gelflow.raster import FlowArray, ImageArray


class Learned:
    """A GelFlow network with weights from a file.

    Args:
        path: Weights, as `gelflow train` writes them.
        name: Name in tables; None: the name of the file's folder and file.
        size: Rows and columns at which the network works; None: those of its training.
        device: "auto" (a CUDA device where there is one), "cpu" or "cuda".

    Raises:
        InputError: The file is missing, damaged or of another model, or the device is not there.
    """

    def __init__(
        self, path: Path, name: str | None = None, size: tuple[int, int] | None = None, device: str = "auto"
    ) -> None:
        import torch

        from gelflow.train.checkpoint import load_weights

        available = torch.cuda.is_available()
        if device == "cuda" and not available:
            raise InputError("--device cuda: no CUDA device was found; use --device cpu")
        self.device = ("cuda" if available else "cpu") if device == "auto" else device
        self.model: Any = load_weights(path, self.device)
        self.name = name or "/".join(path.with_suffix("").parts[-2:])
        self.size = size

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """See `Method.flow`."""
        import torch

        from gelflow.estimate import estimate_flow

        check_images(image1, image2)
        tensors = [torch.from_numpy(np.ascontiguousarray(np.moveaxis(image, -1, 0)))[None].to(self.device)
                   for image in (image1, image2)]  # fmt: skip
        flow = estimate_flow(self.model, tensors[0], tensors[1], self.size)[0]
        return np.ascontiguousarray(np.moveaxis(flow.float().cpu().numpy(), 0, -1))
