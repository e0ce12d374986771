"""Networks with weights from a file behind the interface of all methods: GelFlow's own, and RAFT's published ones."""

import re
from pathlib import Path
from typing import Any

import torch

from gelflow.arrays import FlowArray, ImageArray
from gelflow.baselines.method import as_array, as_tensor
from gelflow.config import REGISTRATIONS, Registration
from gelflow.errors import InputError
from gelflow.fast.method import Fast, fast, is_fast
from gelflow.files.image import check_images
from gelflow.hardware import chosen_device
from gelflow.models.estimate import estimate_flow
from gelflow.models.raft import load_raft, looks_like_raft
from gelflow.models.recorded import RecordedNetwork
from gelflow.models.weights import load_weights
from gelflow.ops.pyramid import resize_flow, resize_images

_END = re.compile(r"((?:#\d+)?(?:\+ft)?)$")
"""The number of a seed and the mark of fine-tuning, which names end with (see `gelflow.compare.seeds`)."""


def open_network(
    path: Path,
    name: str | None = None,
    size: tuple[int, int] | None = None,
    device: str = "auto",
    registration: Registration | None = None,
) -> "Learned | PublishedRaft | Fast":
    """What a file of weights belongs to: GelFlow (.safetensors) or RAFT (.pth), see `Learned`; or `Fast`, by its name.

    InputError where the file is missing, damaged or of another network, the device is not there, or `registration` is
    given for RAFT, or anything for `Fast`.
    """
    if is_fast(path):
        return fast(size, device, registration)
    if not looks_like_raft(path):
        return Learned(path, name, size, device, registration)
    if registration is not None:
        raise InputError(f"--registration {registration}: {path} is RAFT; only the flow of GelFlow's is registered")
    return PublishedRaft(path, name, size, device)


class Learned:
    """A GelFlow network with weights from a file.

    Args:
        path: Weights, as `gelflow train` writes them.
        name: Name in tables; None: the name of the file's folder and file. Where the flow is registered and the name
            does not say so, "+motion", "+both" or "+brightness" is added in front of a seed's number and of "+ft".
        size: Rows and columns at which the network works; None: those of its training, or those of
            `gelflow.models.working_size`.
        device: "auto" (a CUDA device where there is one), "cpu" or "cuda".
        registration: One of `gelflow.config.REGISTRATIONS`; None: what the weights' training asked for.

    Attributes:
        forward: What `flow` costs beside reading and resizing, of tensors (B, 3, H, W) on the device.
        label: The name without what is added to it.
        trained: The architecture as the file has it, its own registration included.

    Raises:
        InputError: The file is missing, damaged or of another model, or the device is not there.
    """

    def __init__(
        self,
        path: Path,
        name: str | None = None,
        size: tuple[int, int] | None = None,
        device: str = "auto",
        registration: Registration | None = None,
    ) -> None:
        self.path = path
        self.device = chosen_device(device)
        self.registration = registration
        if registration is not None and registration not in REGISTRATIONS:
            raise InputError(f"registration = {registration!r}: allowed are {', '.join(REGISTRATIONS)}")
        self.model: Any = load_weights(path, self.device)
        # Convolutions prefer a pixel's channels side by side: a seventh less time for pairs one at a time.
        self.model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # not in torch's stubs
        self.trained = self.model.config
        if registration is not None:
            self.model.config = self.trained.model_copy(update={"registration": REGISTRATIONS[registration]})
        self.forward = RecordedNetwork(self.model)
        self.label = name or "/".join(path.with_suffix("").parts[-2:])
        known = (name for name, config in REGISTRATIONS.items() if config == self.model.config.registration)
        added = f"+{next(known, 'registration')}".replace("+none", "")
        self.name = self.label if added in self.label else _END.sub(rf"{added}\1", self.label, count=1)
        self.size = size

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """See `Method.flow`."""
        check_images(image1, image2)
        tensors = [as_tensor(image, self.device) for image in (image1, image2)]
        return as_array(estimate_flow(self.model, tensors[0], tensors[1], self.size, self.forward))


class PublishedRaft:
    """RAFT, small or large, with published weights; arguments and exceptions as for `Learned`."""

    def __init__(self, path: Path, name: str | None, size: tuple[int, int] | None, device: str) -> None:
        self.device = chosen_device(device)
        self.model: Any = load_raft(path, self.device)
        self.forward = self.model
        self.name = name or f"RAFT {'large' if self.model.large else 'small'}"
        self.size = size

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """See `Method.flow`."""
        check_images(image1, image2)
        native = (image1.shape[0], image1.shape[1])
        tensors = [resize_images(as_tensor(image, self.device), self.size or native) for image in (image1, image2)]
        with torch.no_grad():
            return as_array(resize_flow(self.model(*tensors), native))
