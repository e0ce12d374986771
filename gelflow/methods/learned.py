"""Networks with weights from a file behind the interface of all methods: GelFlow's own, and RAFT's published ones."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from gelflow.arrays import Flow, FlowArray, ImageArray, Images
from gelflow.config import REGISTRATIONS, Registration
from gelflow.errors import InputError
from gelflow.files.image import check_images
from gelflow.hardware import chosen_device
from gelflow.methods.fast import Fast, fast, is_fast
from gelflow.methods.method import as_array, as_tensor
from gelflow.methods.name import MethodName
from gelflow.models.estimate import estimate_flow, flows_at
from gelflow.models.raft import load_raft, looks_like_raft
from gelflow.models.recorded import Recorder
from gelflow.models.weights import load_weights
from gelflow.ops.pyramid import resize_flow, resize_images


def open_network(
    path: Path,
    name: MethodName | None = None,
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
        name: Name in tables; None: the name of the file's folder and file. How the flow is registered is added where
            the label does not say so.
        size: Rows and columns at which the network works; None: those of its training, or those of
            `gelflow.models.working_size`.
        device: "auto" (a CUDA device where there is one), "cpu" or "cuda".
        registration: One of `gelflow.config.REGISTRATIONS`; None: what the weights' training asked for.

    Attributes:
        run: Calls what is computed on the device, and records it on a CUDA device.
        trained: The architecture as the file has it, its own registration included.

    Raises:
        InputError: The file is missing, damaged or of another model, or the device is not there.
    """

    def __init__(
        self,
        path: Path,
        name: MethodName | None = None,
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
        self.run = Recorder()
        name = name or MethodName.parse("/".join(path.with_suffix("").parts[-2:]))
        known = (aim for aim, config in REGISTRATIONS.items() if config == self.model.config.registration)
        aim = next(known, "registration")
        stated = aim == "none" or f"+{aim}" in name.label
        self.name = replace(name, registration="" if stated else aim)
        self.size = size

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """See `Method.flow`."""
        check_images(image1, image2)
        tensors = [as_tensor(image, self.device) for image in (image1, image2)]
        return as_array(estimate_flow(self.model, tensors[0], tensors[1], self.size, self.run))

    def forward(self, image1: Images, image2: Images) -> Flow:
        """What `flow` costs beside reading and resizing, of tensors (B, 3, H, W) on the device."""
        return self.run(flows_at, self.model, ((image1.shape[-2], image1.shape[-1]),), image1, image2)[0]


class PublishedRaft:
    """RAFT, small or large, with published weights; arguments and exceptions as for `Learned`."""

    def __init__(self, path: Path, name: MethodName | None, size: tuple[int, int] | None, device: str) -> None:
        self.device = chosen_device(device)
        self.model: Any = load_raft(path, self.device)
        self.forward = self.model
        self.name = name or MethodName(f"RAFT {'large' if self.model.large else 'small'}")
        self.size = size

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """See `Method.flow`."""
        check_images(image1, image2)
        native = (image1.shape[0], image1.shape[1])
        tensors = [resize_images(as_tensor(image, self.device), self.size or native) for image in (image1, image2)]
        with torch.no_grad():
            return as_array(resize_flow(self.model(*tensors), native))
