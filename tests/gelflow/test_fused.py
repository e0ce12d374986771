"""Kernels for CUDA devices, run on the processor, against the functions that they stand for there."""

from contextlib import contextmanager, nullcontext

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from gelflow.config import RegistrationConfig
from gelflow.models.denoiser import evidence_of
from gelflow.models.evidence import evidence, moments, step
from gelflow.models.propagation import propagated
from gelflow.models.recorded import Recorder
from gelflow.models.registration import registered
from gelflow.models.uncertainty import flow_sigma
from gelflow.models.weights import load_weights, weights_file
from gelflow.ops.gaussian import SeparableFilter
from gelflow.ops.spline import SplineImage
from gelflow.ops.warp import warp

SIZE = (75, 90)
"""No side is a multiple of the windows' spacing and of the network's coarsest pixel."""


def textures(seed: int) -> Tensor:
    """Two images (2, 3, H, W), in [0, 1]."""
    random = np.random.default_rng(seed)
    images = [cv2.GaussianBlur(random.random((*SIZE, 3), np.float32), (0, 0), 1.5) for _ in range(2)]
    return torch.from_numpy(np.stack(images)).movedim(-1, 1).contiguous()


def motion() -> Tensor:
    """Two flows (2, 2, H, W) of up to 9 px, which take some pixels out of the image on each side."""
    random = np.random.default_rng(5)
    flows = [cv2.GaussianBlur(random.normal(0, 90, (*SIZE, 2)).astype(np.float32), (0, 0), 8.0) for _ in range(2)]
    return torch.from_numpy(np.stack(flows)).movedim(-1, 1).contiguous()


@pytest.fixture
def on_device(monkeypatch: pytest.MonkeyPatch):
    """Calls a function without gradient, its tensors taken for those of a CUDA device."""

    def call(function, *arguments):
        with torch.no_grad(), monkeypatch.context() as patch:
            patch.setattr(Tensor, "is_cuda", property(lambda self: True))
            patch.setattr(SeparableFilter, "__call__", lambda self, field: self.down @ field @ self.across.T)
            return function(*arguments)

    return call


def same(found: Tensor, expected: Tensor, close: float) -> None:
    """Rounding in float32, 6e-8 of the largest value, through `close / 6e-8` operations or cancellations at most."""
    torch.testing.assert_close(found, expected, rtol=0, atol=close * float(expected.abs().max()))


def test_what_images_say_of_a_flow(on_device) -> None:
    flow, first, second = motion(), textures(0), SplineImage(textures(1))
    for function in (moments, evidence):
        for sample in (second.near, second.at):
            same(on_device(function, flow, first, sample, 4.0), function(flow, first, sample, 4.0), 1e-5)
    found = evidence(flow, first, second.near, 4.0)
    for one, other in zip(on_device(step, found, 5.0, 2), step(found, 5.0, 2), strict=True):
        same(one, other, 1e-4)


def test_registration_and_sigma(on_device) -> None:
    first, truth = textures(2), 0.2 * motion()
    second = warp(first, -truth, "spline")
    start = truth + 0.2 * motion().flip(0)
    config = RegistrationConfig()
    for function, arguments in (
        (propagated, (start, first, second, 5.0, config)),
        (registered, (start, first, second, config)),
    ):
        # Steps through texture of 1.5 px, which rounding shifts by no more than itself, in ten stages.
        same(on_device(function, *arguments), function(*arguments), 1e-4)
    for function, arguments in ((flow_sigma, (start, first, second)), (evidence_of, (start, truth, first, second))):
        for one, other in zip(on_device(function, *arguments), function(*arguments), strict=True):
            same(one, other, 1e-4)


def test_parts_of_the_network(on_device) -> None:
    network = load_weights(weights_file(None))
    images = textures(3), textures(4)
    with torch.no_grad():
        expected = network(*images)
    for one, other in zip(on_device(network, *images), expected, strict=True):
        same(one, other, 1e-4)


def test_a_call_that_a_device_cannot_record_is_made_as_it_is(on_device, monkeypatch: pytest.MonkeyPatch) -> None:
    class Nothing:
        def wait_stream(self, other: object) -> None: ...

    @contextmanager
    def refused(graph: object):
        yield
        raise RuntimeError("operation not permitted when stream is capturing\nand more")

    for name in ("current_stream", "Stream", "CUDAGraph"):
        monkeypatch.setattr(torch.cuda, name, lambda *_: Nothing())
    monkeypatch.setattr(torch.cuda, "stream", lambda _: nullcontext())
    set_again: list[object] = []
    monkeypatch.setattr(torch.cuda, "set_stream", set_again.append)
    monkeypatch.setattr(torch.cuda, "graph", refused)
    run, doubled = Recorder(), lambda factor, field: (factor * field,)
    with pytest.warns(UserWarning, match="no CUDA graph could be recorded: operation not permitted") as warned:
        found = [on_device(run, doubled, 2, torch.full((2,), float(number)))[0] for number in range(4)]
    assert len(warned) == len(set_again) == 1  # the device goes on with the stream that it had
    assert torch.stack(found)[:, 0].tolist() == [0, 2, 4, 6]
