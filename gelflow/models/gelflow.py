"""The GelFlow network (paper, section 3.1): PWC-Net's coarse-to-fine estimation with local flow fusion at each scale.

From the coarsest scale to s = 2: enlarge the flow so far, warp the second image's features by it, correlate, estimate a
coarse flow, refine it by the context network, fuse it locally. Finer flows, down to the image's own resolution, are
bilinear enlargements: ``V1 = 2 up2(V2)``, ``V0 = 4 up4(V2)``.

The paper is silent on normalising the features (UFlow); without it training from scratch hardly finds motion.

What it cannot do: without `refine` it resolves no detail of the motion finer than about 4 px.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gelflow.arrays import Features, Flow, Images
from gelflow.config import MINIMUM_SIDE, ModelConfig, RegistrationConfig
from gelflow.errors import InputError
from gelflow.hardware import has_bfloat16
from gelflow.models import layers
from gelflow.models.denoiser import Denoiser
from gelflow.models.registration import registered
from gelflow.models.specks import without_specks
from gelflow.ops.correlation import local_correlation
from gelflow.ops.pyramid import enlarge_flow
from gelflow.ops.spline import SplineImage
from gelflow.ops.warp import warp

FINEST_SCALE = 2
"""Finest scale that is decoded."""
CORRELATION_RADIUS = 4
"""Search range of the cost volume in px of the scale, PWC-Net's."""


class GelFlow(nn.Module):
    """Flow from image 1 to image 2 at all scales.

    Attributes:
        config: The architecture.
        image_size: Rows and columns of the images that it was trained on, where they were resized; else None.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.image_size: tuple[int, int] | None = None
        scales = range(FINEST_SCALE, config.levels)
        costs = (2 * CORRELATION_RADIUS + 1) ** 2
        networks = 1 if config.estimator == "shared" else len(scales)
        self.encoder = layers.Encoder(config.levels)
        projected = config.projected_channels
        self.projections = nn.ModuleList(layers.convolution(layers.CHANNELS[s - 1], projected, side=1) for s in scales)
        self.estimators = nn.ModuleList(layers.Estimator(costs + projected + 2) for _ in range(networks))
        self.contexts = nn.ModuleList(layers.ContextNetwork() for _ in range(networks))
        self.fusion = layers.LocalFlowFusion(config.lffm_scale) if config.lffm else None
        self.refinement = layers.RefinementHead() if config.refine == "half" else None

        self.denoiser = Denoiser() if config.denoise else None

    def forward(self, image1: Images, image2: Images) -> list[Flow]:
        """Flows for s = 0 .. levels-2, finest first: (B, 2, ceil(H / 2^s), ceil(W / 2^s)) float32, px of scale s.

        Both images are (B, 3, H, W) float32 in [0, 1]; H, W >= 64, of any parity; InputError for other shapes.
        """
        check_shapes(image1, image2)
        batch, _, height, width = image1.shape
        features = self.encoder(torch.cat([image1, image2]))
        flow: Flow | None = None
        decoded: dict[int, Flow] = {}
        for scale in range(self.config.levels - 1, FINEST_SCALE - 1, -1):
            first, second = features[scale - 1].split(batch)
            size = (first.shape[-2], first.shape[-1])
            if flow is None:
                start = first.new_zeros(batch, 2, *size, dtype=torch.float32)
            else:
                start = enlarge_flow(flow, 1, size)
            flow = self._decode(scale, first, second, start)
            decoded[scale] = flow
        finest = FINEST_SCALE
        for scale in range(finest - 1, -1, -1):
            size = (-(-height // 2**scale), -(-width // 2**scale))
            decoded[scale] = enlarge_flow(decoded[finest], finest - scale, size)
            if self.refinement is not None and scale == 1:
                decoded[scale] = self.refinement(decoded[scale], features[0])
                finest = scale
        return [decoded[scale] for scale in range(self.config.levels - 1)]

    def flow(self, image1: Images, image2: Images) -> Flow:
        """The flow as it is used: the finest of `forward`, registered and denoised where the configuration says so.

        Without gradient, except where nothing is registered. On a processor that multiplies bfloat16, convolutions are
        computed in it, which changes the network's flow by some 0.002 px. Arguments and exceptions as for `forward`.
        """
        reduced = image1.device.type == "cpu" and not torch.is_grad_enabled() and has_bfloat16()
        with torch.autocast("cpu", torch.bfloat16, enabled=reduced):
            flow: Flow = self(image1, image2)[0]
        settings = self.config.registration
        if settings is None:
            return flow
        if settings.background_px is not None:
            image1 = without_specks(flow, image1, image2)
        second = SplineImage(image2.float())
        found = registered(flow, image1, second, settings)
        if self.denoiser is None or settings != RegistrationConfig():
            return found
        with torch.no_grad(), torch.autocast(flow.device.type, torch.bfloat16, enabled=reduced):
            denoised: Flow = self.denoiser(found, flow, image1, second)
            return denoised

    def _decode(self, scale: int, first: Features, second: Features, start: Flow) -> Flow:
        """The flow of one scale from its features (B, C, H, W) and the enlarged flow of the coarser one."""
        place = scale - FINEST_SCALE
        network = 0 if self.config.estimator == "shared" else place
        if start.is_cuda and not torch.is_grad_enabled():
            from gelflow.models import fused_network as fused

            both = fused.side_by_side(first, second, start)
            spread, mean = torch.var_mean(both.view(2, len(start), -1), dim=(0, 2), unbiased=False)
            costs = fused.costs(both, mean, spread + 1e-6, CORRELATION_RADIUS, layers.SLOPE)
        else:
            costs = local_correlation(*normalised(first.float(), warp(second, start)), CORRELATION_RADIUS)
            costs = F.leaky_relu(costs, layers.SLOPE, inplace=not torch.is_grad_enabled())
        projected = self.projections[place](first)
        evidence = torch.cat([part.to(projected.dtype) for part in (costs, projected, start)], dim=1)
        context, correction = self.estimators[network](evidence)
        coarse = start + correction.float()
        refined = coarse + self.contexts[network](context, coarse).float()
        return self.fusion(refined, context.float()) if self.fusion is not None else refined


def normalised(first: Features, second: Features) -> tuple[Tensor, Tensor]:
    """Both images' features shifted and scaled alike, to mean 0 and variance 1 per sample over channels and pixels."""
    both = torch.stack([first, second])
    mean = both.mean(dim=(0, 2, 3, 4), keepdim=True)
    variance = both.var(dim=(0, 2, 3, 4), keepdim=True, unbiased=False)
    one, two = (both - mean) / torch.sqrt(variance + 1e-6)
    return one, two


def check_shapes(image1: Images, image2: Images, least: int = MINIMUM_SIDE) -> None:
    """Refuses images that the network cannot take, as `GelFlow.forward` says, or with sides below `least`."""
    if image1.shape != image2.shape:
        raise InputError(f"the two images differ in shape: {_size(image1)} and {_size(image2)}; give two of one size")
    if image1.ndim != 4 or image1.shape[1] != 3:
        raise InputError(f"images of shape {tuple(image1.shape)}: (pairs, 3 colours, rows, columns) are needed")
    if min(image1.shape[-2:]) < least:
        raise InputError(f"image of {_size(image1)} px: each side must be at least {least} px; enlarge it first")


def _size(image: Tensor) -> str:
    return "x".join(str(side) for side in image.shape[-2:]) if image.ndim == 4 else str(tuple(image.shape))
