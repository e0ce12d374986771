"""The denoiser's loss: errors of its flow relative to those before it, nearby, so that all places count alike."""

import torch
from torch import Tensor

from gelflow.arrays import Flow, Images
from gelflow.losses.multiscale import SOFTNESS_PX
from gelflow.models.denoiser import Denoiser
from gelflow.ops.gaussian import window_sums

WINDOW_PX, SIGMA_WEIGHT, SHARE = 8.0, 0.1, 0.68
"""Deviation of the window of the error before; weight of the loss of sigma; share of the errors that sigma holds."""


def denoising_loss(
    denoiser: Denoiser, flow: Flow, network: Flow, image1: Images, image2: Images, truth: Flow
) -> tuple[Tensor, dict[str, Tensor]]:
    """Mean over the pixels whose true flow is known, from a registered flow (B, 2, H, W).

    Sigma learns by the quantile loss (Koenker and Bassett 1978). "endpoint" is the mean error in px, "registered" that
    before denoising.
    """
    known = torch.isfinite(truth).all(dim=1, keepdim=True)
    truth = torch.where(known, truth, flow)
    denoised, sigma, expected = denoiser.estimate(flow, network, image1, image2)
    error = ((denoised - truth).square().sum(dim=1, keepdim=True) + SOFTNESS_PX**4).sqrt()
    before = (flow - truth).norm(dim=1, keepdim=True)
    window = window_sums(before, WINDOW_PX)
    loss = error / (expected + window(before * known) / window(known.float()).clamp(min=1))
    missed = (error.detach() - sigma) / expected
    loss = loss + SIGMA_WEIGHT * torch.maximum(SHARE * missed, (SHARE - 1) * missed)
    count = known.sum().clamp(min=1)
    parts = {"endpoint": (error * known).sum() / count, "registered": (before * known).sum() / count,
             "within_sigma": ((error <= sigma) & known).sum() / count}  # fmt: skip
    return (loss * known).sum() / count, {name: value.detach() for name, value in parts.items()}
