"""The denoiser's loss: the error of its flow over the root of the registered flow's mean error around the pixel."""

import torch
from torch import Tensor

from gelflow.arrays import Flow, Images, Scalar
from gelflow.models.denoiser import Denoiser
from gelflow.ops.gaussian import window_sums

WINDOW_PX = 8.0
"""Standard deviation of the Gaussian under which the registered flow's error is averaged."""


def denoising_loss(
    denoiser: Denoiser, flow: Flow, network: Flow, image1: Images, image2: Images, truth: Flow
) -> tuple[Scalar, dict[str, Tensor]]:
    """Mean of ``|V - V*| / (s + <|R - V*|>)^(1/2)`` where the true flow V* is known (not NaN).

    V is the denoised flow, R the registered one, (B, 2, H, W), s its expected error; the other arguments are those of
    the denoiser. "endpoint" and "registered" are the mean errors of V and R, px, detached. Without the denominator, few
    pixels in contacts decide; without the root, all count alike, however little they err.
    """
    known = torch.isfinite(truth).all(dim=1, keepdim=True)
    truth = torch.where(known, truth, flow)
    denoised, expected = denoiser.estimate(flow, network, image1, image2)
    error, before = ((found - truth).norm(dim=1, keepdim=True) for found in (denoised, flow))
    with torch.autocast(flow.device.type, enabled=False):
        window = window_sums(before, WINDOW_PX)
        nearby = window(before * known) / window(known.float()).clamp(min=1)
        weighted = error / (expected + nearby).sqrt()
    means = [(field * known).sum() / known.sum().clamp(min=1) for field in (weighted, error, before)]
    return means[0], {"endpoint": means[1].detach(), "registered": means[2]}
