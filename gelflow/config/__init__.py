"""Settings of the network, of the losses and of a training run: validated once, at the edge, then passed down in parts.

Where the paper (Zhang, Yang and Yin, "GelFlow") is silent or can be read in more than one way, the reading is a field
here, its default is stated with its reason, and the alternatives stand beside it. Quantities in px are px of the scale
that they belong to; scale s has 1/2^s of the image's resolution.
"""

from __future__ import annotations

from operator import gt
from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, NonNegativeFloat, model_validator

MINIMUM_SIDE = 64
"""Images with a side below this many px have no coarsest scale worth decoding."""


MAXIMUM_PIXELS = 2048 * 1536
"""Largest size that weights may ask for; a network takes at least 0.9 kB of memory for each pixel."""


def size_problem(rows: int, columns: int) -> str:
    """What keeps a size from being one at which a network works; an empty text where nothing does."""
    if min(rows, columns) < MINIMUM_SIDE:
        return f"[{rows}, {columns}]: each side must be at least {MINIMUM_SIDE} px"
    return f"[{rows}, {columns}]: at most {MAXIMUM_PIXELS} px" if rows * columns > MAXIMUM_PIXELS else ""


class _Frozen(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


Pixels = Annotated[float, Field(le=1000)]


class RegistrationConfig(_Frozen):
    """Registration of the images from the network's flow on, see `gelflow.models.registration`. Not learned."""

    windows_px: Annotated[tuple[Pixels, ...], Field(max_length=16)] = (12.0, 8.0, 5.0)
    """Standard deviation of the Gaussian window of each stage, px of the images that the network sees."""
    smoothing_px: Annotated[tuple[Pixels, ...], Field(max_length=16)] = (6.0, 2.0, 1.0)
    """Standard deviation of the Gaussian that smooths the flow before each stage, px; 0: none."""
    iterations: int = Field(default=2, ge=1, le=100)
    """Gauss-Newton steps of each stage."""
    prior_px: float = Field(default=0.2, gt=0)
    """Error of each component of the flow that a stage starts from, as far as anybody knows without the images."""
    background_px: float | None = Field(default=4.0, gt=0, le=1000)
    """The residual counts without its mean under a Gaussian of this standard deviation, px: shading does not move with
    the gel. None: as it is, flow that explains shading, too."""
    noise: float = Field(default=0.04, gt=0)
    """Standard deviation that the residual has at least in each colour, of a white of 1: the camera's noise, and what
    shading changes. The larger, the more texture a window needs before it outweighs the network."""
    propagation_px: Annotated[tuple[Annotated[int, Field(ge=1, le=4096)], ...], Field(max_length=16)] = (4, 8, 16, 32)
    """Distances of neighbours whose flow is tried before first and last stage, under its window; none: no such step."""
    after: RegistrationConfig | None = None
    """Registration that comes before the stages. Its flow stays where it leaves a residual below its `noise`. Setting
    one of its fields switches it on."""

    @model_validator(mode="after")
    def _has_stages(self) -> RegistrationConfig:
        if not self.windows_px or len(self.windows_px) != len(self.smoothing_px):
            given = f"{list(self.windows_px)} and {list(self.smoothing_px)}"
            raise ValueError(f"windows_px and smoothing_px need one number each for every stage, at least one: {given}")
        if min(self.windows_px) < 1 or min(self.smoothing_px) < 0:
            raise ValueError("windows_px must be at least 1, smoothing_px at least 0")
        if self.after is not None and self.after.after is not None:
            raise ValueError("after: comes before the stages, and nothing before that")
        return self


Registration = Literal["none", "motion", "both", "brightness"]

_BRIGHTNESS = RegistrationConfig(
    windows_px=(12.0, 6.0, 3.0, 1.0), smoothing_px=(4.0, 2.0, 1.0, 0.0), iterations=4, prior_px=1.0,
    background_px=None, noise=0.01, propagation_px=(4, 8, 16, 32, 64, 128),
)  # fmt: skip

REGISTRATIONS: dict[Registration, RegistrationConfig | None] = {
    "none": None,
    "motion": RegistrationConfig(),
    "both": _BRIGHTNESS.model_copy(update={"after": RegistrationConfig()}),
    "brightness": _BRIGHTNESS,
}
"""Registration by the names of the command line: none; for the gel's motion; for both, that is for brightness where
motion leaves a large residual; for brightness, which brings image 2 closest to image 1."""


class ModelConfig(_Frozen):
    """The network: what its weights depend on, and how its flow is refined. Stored with the weights."""

    levels: int = Field(default=8, ge=4, le=8)
    """Scales l of the pyramid, the image (s = 0) included; features at s = 1 .. levels-1. Paper: 8."""
    projected_channels: int = Field(default=32, ge=8, le=128)
    """Channels to which each scale's features are projected by 1x1 convolutions (ARFlow: 32)."""
    estimator: Literal["per_scale", "shared"] = "per_scale"
    """A flow estimator and context network for each scale (PWC-Net) or one for all (ARFlow's PWC-lite), which has a
    third of the weights and takes more steps to follow the motion. The paper names both ancestors and does not say."""
    lffm: bool = True
    """The local flow fusion module; False for the ablation."""
    lffm_scale: Literal["inverse_sqrt", "none"] = "inverse_sqrt"
    """Factor on the module's dot products before the softmax: 1/sqrt(C) for C channels, or 1 as published."""
    refine: Literal["none", "half"] = "none"
    """A refinement head after the last decoded flow: local correlation of fine features around the flow so far, at half
    of the resolution. Not in the paper, whose finest flow is an enlargement of V2."""
    denoise: bool = False
    """Whether a small network takes noise from the flow, where it was registered as by default, for motion; see
    `gelflow.models.denoiser`. Not in the paper."""
    registration: RegistrationConfig | None = None
    """Correction of the network's flow on the images where it is used (validation, evaluation, prediction; neither the
    training steps nor the exported network); in a configuration, a name of `REGISTRATIONS` or a table. Takes no part in
    the weights: a fine-tuning may change it. Not in the paper."""


class LossConfig(_Frozen):
    """The losses and their weights. Letters are the paper's."""

    alpha: float = Field(default=0.85, ge=0, le=1)
    """Share of SSIM in the photometric loss; the rest is the absolute difference."""
    warping: Literal["bilinear", "spline"] = "bilinear"
    """Interpolation of the second image in the loss. The paper names none; bilinear blurs, most at half a px."""
    compare_at: Literal["scale", "image"] = "scale"
    """Where each scale's flow is compared: on the images of its own scale (the paper), whose pattern is averaged away
    at coarse scales, or, enlarged, on the images themselves."""
    occlusion: Literal["none", "forward_backward"] = "none"
    """Pixels that do not count in the photometric loss beside those whose flow leaves the image, for which the second
    image holds no evidence: none (the paper is silent), or those whose flow there and back does not close within a
    tolerance (Meister et al.). The latter estimates both directions and trains on both, which takes twice the time."""
    smoothness: Literal["helmholtz", "first_order", "second_order"] = "helmholtz"
    """Regulariser with weight lambda_dc: the paper's decomposition loss, or ARFlow's edge-aware smoothness of first
    order (SelfFlow, the paper's comparison) or of second (ARFlow). The deformation loss goes with the first only."""
    smoothness_s: tuple[NonNegativeFloat, ...] | None = None
    """Weight of the regulariser at each scale, finest first, in place of lambda_s; None: lambda_s (the paper). ARFlow:
    1 at s = 0 only."""
    lambda_ar: float = Field(default=0.0, ge=0)
    """Weight of ARFlow's augmentation consistency: on transformed images the network should see the transformed flow.
    Takes a second pass of the network. ARFlow: 0.01."""
    second_stage: float = Field(default=0.0, ge=0, lt=1)
    """Share of the steps after which `occlusion` and `lambda_ar` begin, which rely on the network's own flow. 0: from
    the start, for a network that has learnt before. ARFlow has them in later stages, too."""
    lambda_dc: float = Field(default=75.0, ge=0)
    """Weight of the regulariser, whose flow is divided by the shorter side of the image (scale 0, in px, for all scales
    alike, as ARFlow does). With flow in px, the paper's 75 makes training collapse to no flow."""
    lambda_theta: float = Field(default=0.01, ge=0)
    """Weight of the shear distortion rate within the decomposition loss."""
    lambda_zeta: float = Field(default=0.01, ge=0)
    """Weight of the rotation within the decomposition loss."""
    lambda_df: float = Field(default=0.01, ge=0)
    """Weight of the deformation loss."""
    beta: float = Field(default=10.0, ge=0)
    """Steepness of the weight in the image gradient."""
    least_weight: float = Field(default=0.0, ge=0, le=1)
    """Smallest weight of the decomposition and deformation losses at a pixel. Paper: 0, where there is no texture."""
    lambda_s: tuple[NonNegativeFloat, ...] = (1.0,) * 7
    """Weight of each scale, finest (s = 0) first; levels - 1 numbers. Paper: 1 for s = 0 .. 6. A scale of weight 0 is
    not computed."""
    flow_s: tuple[NonNegativeFloat, ...] | None = None
    """Weight of each scale in training on the exact flow, finest first, errors in px of the scale; None: lambda_s.
    Coarse scales, at which images hold no pattern, learn their flow here."""

    @model_validator(mode="after")
    def _some_scale_counts(self) -> LossConfig:
        if not any(self.lambda_s):
            raise ValueError(f"lambda_s = {list(self.lambda_s)}: needs at least one of them above 0")
        for name, weights in (("smoothness_s", self.smoothness_s), ("flow_s", self.flow_s)):
            if weights is not None and len(weights) != len(self.lambda_s):
                raise ValueError(f"{name} has {len(weights)} numbers, lambda_s {len(self.lambda_s)}")
        if self.flow_s is not None and not any(self.flow_s):
            raise ValueError("flow_s is 0 at every scale: nothing would be compared with the exact flow")
        return self


class MotionConfig(_Frozen):
    """Motion added to training pairs by moving image 2, see `gelflow.training.augment`.

    Uniform up to these limits, times a common factor that is uniform between 0 and 1.
    """

    shift_px: float = Field(default=12.0, ge=0)
    """Along each axis, px of the images before cropping."""
    turn_deg: float = Field(default=12.0, ge=0, le=45)
    """About the image's centre, to either side."""
    zoom: float = Field(default=0.08, ge=0, le=0.5)
    """Enlargement or reduction, as a share."""


class TrainConfig(_Frozen):
    """A training run. Together with the data, the seed and the initial weights it determines the result."""

    model: ModelConfig = ModelConfig()
    loss: LossConfig = LossConfig()
    supervision: Literal["self", "flow", "mixed", "registered"] = "self"
    """Train on the images alone (the paper), or on the exact flow by the multi-scale endpoint loss, or on whichever a
    pair has: exact flow where it is known, the images alone where it is not (synthetic and real pairs side by side).
    Under "registered", only the denoiser learns: to correct registered flow towards the exact one."""
    mixed_self: float = Field(default=10.0, gt=0)
    """Weight of the self-supervised loss, which changes less with a px of error, beside the endpoint loss under
    supervision = "mixed"."""
    frames_apart: int | None = Field(default=None, ge=1)
    """Of clips of synth, pairs of frames that many apart; None: each frame with that at rest."""
    image_size: tuple[int, int] | None = None
    """Rows and columns to which images are resized before the network (the paper: 512, 640); None: as they are."""
    crop_size: tuple[int, int] | None = None
    """Rows and columns of a random crop taken after resizing, for training only; None: the whole image. Cuts the time
    of a step without changing the scale of the pattern."""
    flip: bool = True
    """Random horizontal and vertical flips, but for bare gels. The paper is silent on augmentation."""
    color_jitter: float = Field(default=0.0, ge=0, le=0.5)
    """Standard deviation of the logarithm of a random gain per colour channel, common to both images of a pair; bare
    gels keep their colours."""
    compression: float = Field(default=0.0, ge=0, le=1)
    """Largest step of a random compression of pairs with exact flow, except those of bare gels, in units of white;
    see `gelflow.ops.compression`. Recordings are compressed, rendered images are not."""
    specks: float = Field(default=0.0, ge=0, le=1)
    """Share of the pairs with exact flow, except those of bare gels, that get random specks in the optics, which stand
    still; see `gelflow.training.specks`."""
    motion: MotionConfig | None = None
    """Motion added to each pair but those of bare gels, for a network that meets larger motions than its training pairs
    show; None: none (the paper is silent)."""
    batch_size: int = Field(default=4, ge=1)
    """Pairs per step and device. Paper: 4."""
    steps: int = Field(default=66_400, ge=1)
    """Optimiser steps. The paper's 200 epochs of 1327 pairs in batches of 4."""
    learning_rate: float = Field(default=1e-4, gt=0)
    """Adam's learning rate (its peak, for one_cycle). The paper is silent; ARFlow: 1e-4."""
    schedule: Literal["constant", "one_cycle"] = "constant"
    """Learning rate over the run: constant after the warm-up, or falling from its peak to zero as a half cosine."""
    warmup_steps: int = Field(default=0, ge=0)
    """Steps over which the learning rate rises linearly from zero."""
    weight_decay: float = Field(default=1e-6, ge=0)
    """Adam's L2 penalty. The paper is silent; ARFlow: 1e-6."""
    gradient_clip: float | None = Field(default=None, gt=0)
    """Largest norm of the gradient; None: no limit."""
    validate_every: int = Field(default=500, ge=1)
    """Steps between validations."""
    save_every: int = Field(default=500, ge=1)
    """Steps between saves of the whole state; it is also saved at the end and on Ctrl-C or SIGTERM."""
    workers: int = Field(default=0, ge=0)
    """Processes that load data; 0: in the training process."""
    seed: int = Field(default=0, ge=0, lt=2**32)
    """Seed of the initial weights, of the order of the pairs and of the augmentation."""
    precision: Annotated[Literal["32", "bf16"], BeforeValidator(str)] = "32"
    """float32, or bfloat16 for the convolutions; flows and losses are float32 in both."""
    ema_decay: float = Field(default=0.0, ge=0, lt=1)
    """Validate and keep an exponential moving average of the weights, decay per step (0.999 is usual); 0: the weights
    themselves (the paper is silent)."""
    cuda_graph: bool = True
    """On a CUDA device, record the network's two passes at the first step and replay them; not under "registered"."""
    cache: bool = True
    """On a CUDA device, decode all pairs at the start (by `workers`) and keep them there, if they take no more than
    half of its free memory. Otherwise the files of a pair are decoded anew whenever a step asks for it."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to train; auto: a CUDA device where there is one."""
    devices: int = Field(default=1, ge=1)
    """Number of devices (on a CPU: processes) on each machine; each takes batch_size pairs a step."""
    nodes: int = Field(default=1, ge=1)
    """Number of machines that train together; the same command is started on each, see Lightning's `num_nodes`."""

    @property
    def exact(self) -> bool:
        """Whether every pair needs an exact flow."""
        return self.supervision in ("flow", "registered")

    @model_validator(mode="after")
    def _fits_together(self) -> TrainConfig:
        if self.supervision == "registered" and (
            not self.model.denoise or self.model.registration != RegistrationConfig()
        ):
            raise ValueError('supervision = "registered" needs model.denoise = true and model.registration = "motion"')
        scales = self.model.levels - 1
        if len(self.loss.lambda_s) != scales:
            raise ValueError(f"loss.lambda_s has {len(self.loss.lambda_s)} numbers; model.levels asks for {scales}")
        for name, size in (("image_size", self.image_size), ("crop_size", self.crop_size)):
            if size is not None and (problem := size_problem(*size)):
                raise ValueError(f"{name} = {problem}")
        if self.image_size and self.crop_size and any(map(gt, self.crop_size, self.image_size)):
            raise ValueError(f"crop_size = {list(self.crop_size)} does not fit into image_size {list(self.image_size)}")
        if self.warmup_steps >= self.steps:
            raise ValueError(f"warmup_steps = {self.warmup_steps} must be below steps = {self.steps}")
        return self
