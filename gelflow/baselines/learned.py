"""Networks with weights from a file behind the interface of all methods: GelFlow's own, and RAFT's published ones."""

from pathlib import Path
from typing import Any

import numpy as np

from gelflow.baselines.method import check_images
from gelflow.errors import InputError
from gelflow.raster import FlowArray, ImageArray


def open_network(
    path: Path, name: str | None = None, size: tuple[int, int] | None = None, device: str = "auto"
) -> "Learned | PublishedRaft":
    """The network that a file of weights belongs to: GelFlow (.safetensors) or RAFT (.pth).

    Args:
        path: Weights.
        name: Name in tables; None: the name of the file's folder and file.
        size: Rows and columns at which the network works; None: those of its training, or of the images.
        device: "auto" (a CUDA device where there is one), "cpu" or "cuda".

    Raises:
        InputError: The file is missing, damaged or of another network, or the device is not there.
    """
    from gelflow.models.raft import looks_like_raft

    return (PublishedRaft if looks_like_raft(path) else Learned)(path, name, size, device)


def chosen_device(device: str) -> str:
    """The device that an option stands for.

    Raises:
        InputError: A CUDA device is asked for and there is none.
    """
    import torch

    available = torch.cuda.is_available()
    if device == "cuda" and not available:
        raise InputError("--device cuda: no CUDA device was found; use --device cpu")
    return ("cuda" if available else "cpu") if device == "auto" else device


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
        from gelflow.train.checkpoint import load_weights

        self.path = path
        self.device = chosen_device(device)
        self.model: Any = load_weights(path, self.device)
        self.name = name or "/".join(path.with_suffix("").parts[-2:])
        self.size = size

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """See `Method.flow`."""
        from gelflow.estimate import estimate_flow

        check_images(image1, image2)
        tensors = [_tensor(image, self.device) for image in (image1, image2)]
        return _array(estimate_flow(self.model, tensors[0], tensors[1], self.size))


class PublishedRaft:
    """RAFT, small or large, with published weights; arguments and exceptions as for `Learned`.

    Images work at their own size unless one is given.
    """

    def __init__(
        self, path: Path, name: str | None = None, size: tuple[int, int] | None = None, device: str = "auto"
    ) -> None:
        from gelflow.models.raft import load_raft

        self.path = path
        self.device = chosen_device(device)
        self.model: Any = load_raft(path, self.device)
        self.name = name or f"RAFT {'large' if self.model.large else 'small'}"
        self.size = size

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """See `Method.flow`."""
        import torch

        from gelflow.estimate import resize_flow, resize_images

        check_images(image1, image2)
        native = (image1.shape[0], image1.shape[1])
        tensors = [resize_images(_tensor(image, self.device), self.size or native) for image in (image1, image2)]
        with torch.no_grad():
            return _array(resize_flow(self.model(*tensors), native))


def _tensor(image: ImageArray, device: str) -> Any:
    import torch

    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(image, -1, 0)))[None].to(device)


def _array(flow: Any) -> FlowArray:
    return np.ascontiguousarray(np.moveaxis(flow[0].float().cpu().numpy(), 0, -1))
