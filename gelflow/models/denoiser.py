"""Denoiser: the registered flow without its noise. Learned, by a small U-Net (Ronneberger, Fischer and Brox 2015).

Registration estimates each pixel's flow in a round window and leaves noise. The gel's true motion is smoother than this
noise, but bends along lines, which a round window blurs. The denoiser sees what a Gauss-Newton step finds in two
windows, and with which variance (`gelflow.models.evidence`), the flow in three bands of frequencies, what registration
changed, and the image. All displacements are divided by the flow's expected error s, that of the default registration.
So what it learns on one sensor fits others, and its answer is a correction in units of s.
"""

from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gelflow.arrays import Features, Flow, Images
from gelflow.config import RegistrationConfig
from gelflow.models.evidence import evidence, step
from gelflow.models.registration import posterior_variance
from gelflow.models.wider_window import TWO_STEPS
from gelflow.ops.gaussian import interpolator, smoother
from gelflow.ops.spline import SplineImage

CHANNELS = (32, 48, 64, 96)
"""Channels at a half, a quarter, an eighth and a sixteenth of the images' resolution."""
BANDS_PX = (2.0, 6.0, 16.0)
"""Standard deviations of the Gaussians between the flow's bands of frequencies."""
WINDOWS_PX = (2.0, 5.0)
"""Windows of the Gauss-Newton steps; s is that of the last."""
TEXTURE_PX = 4.0
"""The image is given less its mean under a Gaussian of this standard deviation, over its contrast under twice that."""
APPLIED = 0.7
"""Share of the correction that is applied. The whole of it errs less on synthetic pairs, but leads away from dots on
some real ones."""
MIN_ERROR_PX, MIN_CONTRAST = 0.003, 1e-3
_INPUTS = 2 + 2 * len(BANDS_PX) + 3 * len(WINDOWS_PX) + 3


class Denoiser(nn.Module):
    """Corrects a registered flow; a fresh one leaves it as it is."""

    def __init__(self) -> None:
        super().__init__()
        first, *_, last = CHANNELS
        self.entry = nn.Sequential(nn.Conv2d(4 * _INPUTS, first, 3, padding=1), Block(first, first))
        self.down = nn.ModuleList(Block(fine, coarse) for fine, coarse in pairwise(CHANNELS))
        self.bottom = Block(last, last)
        self.up = nn.ModuleList(Block(fine + coarse, fine) for fine, coarse in reversed(list(pairwise(CHANNELS))))
        self.head = nn.Conv2d(first, 4 * 2, 3, padding=1)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]

    def forward(self, flow: Flow, network: Flow, image1: Images, image2: Images | SplineImage) -> Flow:
        """A registered flow (B, 2, H, W) of two images without its noise; `network` is the flow before registration."""
        denoised, _ = self.estimate(flow, network, image1, image2)
        return torch.lerp(flow, denoised, APPLIED)

    def estimate(self, flow: Flow, network: Flow, image1: Images, image2: Images | SplineImage) -> tuple[Flow, Tensor]:
        """The flow with the whole correction, and s, (B, 1, H, W) px."""
        with torch.no_grad(), torch.autocast(flow.device.type, enabled=False):
            inputs, error = evidence_of(flow, network, image1, image2)
        height, width = flow.shape[-2:]
        multiple = 2 ** len(CHANNELS)
        inputs = F.pad(inputs, (0, -width % multiple, 0, -height % multiple), mode="replicate")
        # `F.pixel_unshuffle`, which takes four times as long.
        quarters = torch.stack([inputs[..., i::2, j::2] for i in (0, 1) for j in (0, 1)], dim=2)
        state = self.entry(quarters.flatten(1, 2))
        skipped = []
        for block in self.down:
            skipped.append(state)
            state = block(F.avg_pool2d(state, 2))
        state = self.bottom(state)
        for block in self.up:
            fine = skipped.pop()
            state = block(torch.cat([fine, F.interpolate(state, scale_factor=2, mode="bilinear")], dim=1))
        found = F.pixel_shuffle(self.head(F.gelu(state)), 2)[..., :height, :width].float()
        return flow + error * found, error


class Block(nn.Module):
    """A residual block of two convolutions."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.GELU(), nn.Conv2d(inputs, outputs, 3, padding=1), nn.GELU(), nn.Conv2d(outputs, outputs, 3, padding=1)
        )
        self.skip = nn.Conv2d(inputs, outputs, 1) if inputs != outputs else nn.Identity()

    def forward(self, state: Features) -> Features:
        """Features (B, C, H, W) of other channels."""
        changed: Tensor = self.skip(state) + self.layers(state)
        return changed


def evidence_of(flow: Flow, network: Flow, image1: Images, image2: Images | SplineImage) -> tuple[Features, Tensor]:
    """What the denoiser sees, (B, C, H, W), and the flow's expected error s, (B, 1, H, W) px."""
    config, to_pixels = RegistrationConfig(), interpolator(flow, 2)
    second = image2 if isinstance(image2, SplineImage) else SplineImage(image2)
    found = evidence(flow, image1, second.near, config.background_px or 0.0)
    steps = [step(found, width, 2) for width in WINDOWS_PX]
    variance = posterior_variance(TWO_STEPS * steps[-1].variance, config.prior_px)
    logarithms = [one.variance.clamp(min=MIN_ERROR_PX**2).log() for one in steps]
    logarithms.append(variance.sqrt().clamp(min=MIN_ERROR_PX).log())
    at_places = to_pixels(torch.cat([*(one.step for one in steps), *logarithms], dim=1))
    found_steps, logarithms = at_places.split([2 * len(steps), len(logarithms)], dim=1)
    error = logarithms[:, -1:].exp()
    smooth = [flow, *(to_pixels(smoother(flow, width, 2)(flow)) for width in BANDS_PX)]
    bands = [fine - coarse for fine, coarse in pairwise(smooth)]
    grey = image1.mean(dim=1, keepdim=True)
    texture = grey - smoother(grey, TEXTURE_PX)(grey)
    contrast = to_pixels(smoother(grey, 2 * TEXTURE_PX, 2)(texture.square())).clamp(min=MIN_CONTRAST**2).sqrt()
    displacements = torch.cat([network - flow, *bands, found_steps], dim=1)
    seen = [compressed(displacements / error), logarithms, texture / contrast, contrast.log()]
    return torch.cat(seen, dim=1), error


def compressed(field: Features) -> Features:
    """Large values on a logarithmic scale, with their sign."""
    return field.abs().log1p_().copysign_(field)
