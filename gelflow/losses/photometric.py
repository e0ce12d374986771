"""Photometric loss (paper, eq. 10): how well image 2, warped by the flow, matches image 1.

``L_ph = alpha (1 - SSIM) / 2 + (1 - alpha) |I~1 - I1|``, averaged over colours and pixels.

SSIM is taken over 3x3 windows with equal weights, C1 = 0.01^2, C2 = 0.03^2, for images in [0, 1]; at the border the
window is what of it lies inside the image. The paper is silent on pixels that leave the image: here, their absolute
difference does not count, nor does the SSIM of any window that holds one of them.

Occlusion. Pixels whose point is seen in both images, by the flows there and back (Meister, Hur and Roth 2018, eq. 3).

A pixel counts where ``|f(x) + b(x + f(x))|^2 <= 0.01 (|f(x)|^2 + |b(x + f(x))|^2) + 0.5 px^2``: a share of the motion
and a constant, so that neither small errors of large motions nor the noise of small ones exclude pixels. Where hardly
a pixel of a pair would be left, the flow is wrong and not the scene hidden, and all pixels count: a loss over none has
no gradient.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from gelflow.arrays import Flow, Images, Mask, Scalar
from gelflow.ops.warp import inside, warp

C1 = 0.01**2
C2 = 0.03**2


def structural_similarity(first: Images, second: Images) -> Tensor:
    """SSIM (Wang et al. 2004) of each pixel's 3x3 window, in [-1, 1]."""

    def mean(values: Tensor) -> Tensor:
        return F.avg_pool2d(values, 3, stride=1, padding=1, count_include_pad=False)

    mean1, mean2 = mean(first), mean(second)
    variance1 = mean(first * first) - mean1 * mean1
    variance2 = mean(second * second) - mean2 * mean2
    covariance = mean(first * second) - mean1 * mean2
    luminance = (2 * mean1 * mean2 + C1) / (mean1 * mean1 + mean2 * mean2 + C1)
    return luminance * (2 * covariance + C2) / (variance1 + variance2 + C2)


def photometric_loss(image1: Images, image2: Images, flow: Flow, alpha: float) -> Scalar:
    """The photometric loss at one scale; 0 where the flow takes every pixel out of the image."""
    return appearance_loss(image1, warp(image2, flow), inside(flow), alpha)


def appearance_loss(image1: Images, warped: Images, pixels: Mask, alpha: float) -> Scalar:
    """The photometric loss of an image that has been warped already.

    The mask is 1 where the warped image is worth comparing; `alpha` is the share of SSIM.
    """
    dissimilarity = (1 - structural_similarity(image1.to(warped.dtype), warped)) / 2
    difference = (warped - image1).abs()
    windows = -F.max_pool2d(-pixels, 3, stride=1, padding=1)
    return alpha * _masked_mean(dissimilarity, windows) + (1 - alpha) * _masked_mean(difference, pixels)


def _masked_mean(values: Tensor, mask: Mask) -> Scalar:
    return (values * mask).sum() / (mask.sum() * values.shape[1]).clamp(min=1)


RELATIVE, ABSOLUTE_PX2 = 0.01, 0.5
MIN_VISIBLE_SHARE = 0.1
"""Share of a pair's pixels below which the flow counts as wrong and no pixel as hidden."""


def visible_in_both_images(forward: Flow, backward: Flow) -> Mask:
    """1 where the flow there and back closes, else 0; also 0 where it leaves the image. Without gradient.

    Pairs with less than `MIN_VISIBLE_SHARE` of such pixels have 1 wherever the flow does not leave the image.
    """
    with torch.no_grad():
        back = warp(backward, forward)
        closure = (forward + back).square().sum(dim=1, keepdim=True)
        motion = forward.square().sum(dim=1, keepdim=True) + back.square().sum(dim=1, keepdim=True)
        closed = closure <= RELATIVE * motion + ABSOLUTE_PX2
        closes_anywhere = closed.float().mean(dim=(1, 2, 3), keepdim=True) >= MIN_VISIBLE_SHARE
        return inside(forward) * (closed | ~closes_anywhere).to(forward.dtype)
