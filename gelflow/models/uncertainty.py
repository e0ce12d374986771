"""Uncertainty: how far a flow may be from the motion, from the two images alone. Nothing is learned.

From the flow V a Gauss-Newton step leads to what the images say under a narrow window, and
`gelflow.models.wider_window` from there to V*, what they say under the window that fits the place, with its mean square
error e. What V misses of it is an error, too. Bias within the window is not seen: it has one flow for all its texture,
which lies at a mean square distance m from x, so that the flow's second derivatives V'' add an error. Where e and m of
the finer window of the registration's further stage make the sum smaller, they count instead. Together,

    sigma^2 = RADIUS^2 / 2 (e + |V - V*|^2 + (CURVATURE m |V''|)^2),

smoothed, because the flow is. Where the narrow window finds nothing, e + |V - V*|^2 and m are means under a wider one,
over those places alone of which the images say more than the network: between dots a flow is known unless it bends. A
bare gel has no such places, so that nothing is known, however plausible its flow. Over all places, wide windows would
take light for texture. Near specks in the optics, the error of `gelflow.models.specks` is added to e. An error that
leaves no trace in the images is not seen; dots taken for the next ones are `gelflow.fast.certainty`'s matter.
"""

import math

import torch
from torch import Tensor

from gelflow.arrays import Features, Flow, Images
from gelflow.config import RegistrationConfig
from gelflow.models.evidence import TINY, evidence, step
from gelflow.models.registration import FINE_WINDOW_PX, MAX_STEP_PX, SPACING
from gelflow.models.specks import speck_error
from gelflow.models.wider_window import MIN_VARIANCE, TWO_STEPS, best_window, fine_noise
from gelflow.ops.gaussian import SeparableFilter, doubled, smoother, window_sums
from gelflow.ops.spline import SplineImage
from gelflow.ops.warp import pixel_indices, positions

CURVATURE = 0.1
"""Fitted to the errors of the shipped network on synthetic pairs by `python -m benchmarks sigma`."""
SMOOTHING_PX = 2.0
"""Standard deviation of the Gaussian under which sigma^2 is smoothed."""
CERTAIN_PX, UNKNOWN_PX, MAX_SIGMA_PX = 0.1, 1.0, 10.0
"""A flow counts as certain up to the first sigma and as unknown above the second; the last: nothing is known."""
RADIUS = math.sqrt(-2 * math.log(1 - 0.68))
"""Radius that holds 68 % of a normal distribution in the plane whose components have a standard deviation of 1."""
_MOTION = RegistrationConfig()


def flow_sigma(flow: Flow, image1: Images, image2: Images) -> tuple[Tensor, Tensor]:
    """The uncertainty of a flow (B, 2, H, W), by whatever method.

    Sigma, the radius in px within which 68 % of such flows are right, at most `MAX_SIGMA_PX`; and the probability that
    the pixel's point lies in image 2. Both are (B, 1, H, W), and `MAX_SIGMA_PX` and 0 where the flow is NaN.
    """
    with torch.no_grad(), torch.autocast(flow.device.type, enabled=False):
        known, flow = flow.isfinite().all(dim=1, keepdim=True), flow.float().nan_to_num()
        error, curvature = error_squares(flow, image1.float(), image2.float())
        sigma = combined(error, curvature, CURVATURE)
        sigma = torch.where(known, sigma, MAX_SIGMA_PX).clamp(max=MAX_SIGMA_PX)
        sides = pixel_indices(flow)[:, -1:, -1:] + 1  # on the device, for a recording
        place, spread = positions(flow) + 0.5, sigma / RADIUS
        inside = torch.special.ndtr((sides - place) / spread) - torch.special.ndtr(-place / spread)
        return sigma, known * inside.prod(dim=1, keepdim=True)


def error_squares(flow: Flow, image1: Images, image2: Images) -> tuple[Tensor, Tensor]:
    """The squares e + |V - V*|^2 and (m |V''|)^2, both (B, 1, H, W) px^2; CURVATURE decides whose e and m count."""
    narrow_px = _MOTION.windows_px[-1]
    seen = evidence(flow, image1, SplineImage(image2).at, _MOTION.background_px or 0.0)
    found, finer = (step(seen, width, SPACING) for width in (narrow_px, FINE_WINDOW_PX))
    window, fine = (window_sums(flow, width, SPACING) for width in (narrow_px, FINE_WINDOW_PX))
    gradient = seen[:, :1] + seen[:, 2:3]
    variance = (TWO_STEPS * found.variance).clamp(min=MIN_VARIANCE)
    given = smoother(flow, 0.0, SPACING)(flow)
    narrow = given + found.step.clamp(-MAX_STEP_PX, MAX_STEP_PX)
    best, least = best_window(narrow, variance, found.texture, narrow_px, SPACING)
    known, missed = variance < UNKNOWN_PX**2, (given - best).square().sum(dim=1, keepdim=True)
    error = torch.where(known, least, variance)
    moment = torch.where(known, second_moment(window, gradient) / found.texture, 0.0)
    bend = curvature_square(given, SPACING)
    # The further stage's window, where it errs by less: usually where the flow bends.
    fine_error = (fine_noise(narrow_px, FINE_WINDOW_PX)[1] * finer.variance).clamp(min=MIN_VARIANCE)
    fine_moment = second_moment(fine, gradient) / finer.texture
    narrowed = fine_error + (CURVATURE * fine_moment).square() * bend < error + (CURVATURE * moment).square() * bend
    narrowed &= known
    error = torch.where(narrowed, fine_error, error) + missed
    moment = torch.where(narrowed, fine_moment, moment)
    # Its windows see places, not px.
    wide = window_sums(error, _MOTION.windows_px[0] / SPACING)
    error, moment = between_marks(error, moment / SPACING**2, variance, wide)
    moment = SPACING**2 * moment
    maps = torch.cat([error, moment.square() * bend, known.to(error.dtype)], dim=1)
    maps = doubled(maps)[..., : flow.shape[-2], : flow.shape[-1]]
    error, curvature, known = maps.split(1, dim=1)
    return error + speck_error(flow, image1, image2, known * gradient), curvature


def combined(error: Tensor, curvature: Tensor, factor: float) -> Tensor:
    """Sigma in px from squared errors in px^2, smoothed; the largest count as much as `MAX_SIGMA_PX`."""
    square = (RADIUS**2 / 2) * (error + factor**2 * curvature)
    window = window_sums(square, SMOOTHING_PX)
    return (window(square.clamp(max=MAX_SIGMA_PX**2)) / window(torch.ones_like(square))).sqrt()


def between_marks(error: Tensor, moment: Tensor, variance: Tensor, wide: SeparableFilter) -> tuple[Tensor, Tensor]:
    """Error and moment, where the variance of the narrow window is that of nothing known, from marks around."""
    marks = (variance < 2 * _MOTION.prior_px**2) / variance
    weight = wide(marks)
    between = (variance >= UNKNOWN_PX**2) & (weight > TINY)
    error = torch.where(between, wide(marks * error) / weight, error)
    return error, torch.where(between, second_moment(wide, marks) / weight, moment)


def second_moment(window: SeparableFilter, field: Features) -> Features:
    """The sum of w(y - x) |y - x|^2 f(y)."""
    spacing = math.ceil(field.shape[-2] / len(window.down))
    x, y = pixel_indices(field)
    squares = (((spacing - 1) / 2 + p[::spacing].view(-1, 1) - p).square() for p in (y[:, 0], x[0]))
    down, across = (matrix * square for matrix, square in zip(window[:2], squares, strict=True))
    return SeparableFilter(down, window.across)(field) + SeparableFilter(window.down, across)(field)


def curvature_square(flow: Flow, pixel: int = 1) -> Tensor:
    """|V''|^2 of a flow at every `pixel`-th px under the last stage's smoothing, px^-2; (B, 1, H, W)."""
    smooth = smoother(flow, _MOTION.smoothing_px[-1] / pixel)(flow) / pixel**2
    slopes = torch.cat(torch.gradient(smooth, dim=(-1, -2)), dim=1)
    return torch.cat(torch.gradient(slopes, dim=(-1, -2)), dim=1).square().sum(dim=1, keepdim=True)
