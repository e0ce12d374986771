"""A trained network as ONNX: two images in, the flow out, at one fixed size.

    image1, image2  (1, 3, H, W) float32, RGB in [0, 1]
    flow            (1, 2, H, W) float32, U right and V down in px, I1(x) = I2(x + flow(x))

Needs the packages onnx and onnxscript to write. The size is fixed because warping and pyramids depend on it.
"""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import nn

from gelflow.arrays import Flow, Images
from gelflow.config import MINIMUM_SIDE
from gelflow.errors import InputError
from gelflow.files.atomic import refuse_foreign, replacing
from gelflow.files.quiet import quiet_logger
from gelflow.models import GelFlow
from gelflow.models.weights import load_weights

OPSET = 18
PRODUCER = "gelflow"
NEEDED = ("onnx", "onnxscript")


def export_onnx(weights: Path, out: Path, size: tuple[int, int] | None = None) -> tuple[int, int]:
    """Writes a network, from a file of `gelflow train`, as ONNX to a file ending in .onnx, as a whole or not at all.

    `size`, rows and columns, is by default that of the training images, if they were resized to one size. Returns the
    size that the file works at. InputError where a package is missing, no size is known, a side is below 64 px, the
    weights cannot be used, or `out` is a file from elsewhere; OSError where it cannot be written.
    """
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        raise InputError(f"export needs the package {' and '.join(missing)}; pip install {' '.join(NEEDED)}")
    if out.suffix != ".onnx":
        raise InputError(f"--out {out}: a file ending in .onnx is needed")
    refuse_foreign(out, PRODUCER.encode())
    model = load_weights(weights)
    chosen = size or model.image_size
    if chosen is None:
        raise InputError(f"{weights}: was trained on images of any size; give --size ROWSxCOLUMNS")
    if min(chosen) < MINIMUM_SIDE:
        raise InputError(f"--size {chosen[0]}x{chosen[1]}: each side must be at least {MINIMUM_SIDE} px")
    example = tuple(torch.zeros(1, 3, *chosen) for _ in range(2))
    with quiet_logger("torch.onnx"), replacing(out) as temporary, torch.no_grad():
        program: Any = torch.onnx.export(
            _Finest(model).eval(), example, input_names=["image1", "image2"], output_names=["flow"],
            opset_version=OPSET, dynamo=True, verbose=False,
        )  # fmt: skip
        program.model.producer_name = PRODUCER
        program.save(str(temporary), external_data=False)
    return chosen


class _Finest(nn.Module):
    """A network with its finest flow as its only answer."""

    def __init__(self, model: GelFlow) -> None:
        super().__init__()
        self.model = model

    def forward(self, image1: Images, image2: Images) -> Flow:
        flow: Flow = self.model(image1, image2)[0]
        return flow
