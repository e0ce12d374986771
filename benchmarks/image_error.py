r"""The error of rendered images, measured against a reference image that has an error, too.

Images are compared as the camera sees them: blurred, exposed and encoded, before camera noise and quantisation, in
levels of 255. With R images :math:`t_k` of different seeds, the two halves :math:`a, b` of the reference
:math:`r = (a + b) / 2`, all independent, and means over pixels and channels,

.. math::

    noise^2 &= \mathrm{mean}\,\mathrm{var}_k\,t_k, \qquad reference^2 = \mathrm{mean}\,(a - b)^2 / 4 \\
    rmse^2 &= \mathrm{mean}_k\,\mathrm{mean}\,(t_k - r)^2 - reference^2 \\
    systematic^2 &= rmse^2 - noise^2

are unbiased. The last is what no number of samples removes. It is a sum of products of independent errors: with
:math:`\sigma^2 = \mathrm{var}\,t_k` and :math:`\tau^2 = \mathrm{var}\,r`, its variance per pixel is
:math:`2 \sigma^4 / (R (R - 1)) + 4 \sigma^2 \tau^2 / R + 4 \tau^4` where there is no systematic error. A Gaussian blur
of b px correlates such products over :math:`2 \pi b^2` pixels; the channels count as one.

Encoding is concave and turns noise into a shift. The bias, the relative error of the mean over the image, is therefore
taken of the linear signal without blur, where pixels are independent: over N of them its squared standard error is
:math:`(\mathrm{mean}\,\mathrm{var}_k\,t_k / R + reference^2) / N`.
"""

import math
import time
from collections.abc import Sequence
from statistics import median

import numpy as np

from synth.arrays import FloatArray, Image, Points
from synth.render.camera_image import camera_image, encoded, expected_signal
from synth.render.renderer import Renderer
from synth.scene import Camera

LEVELS = 255
Halves = tuple[Image, Image]
"""Radiances (H, W, 3) of one state with different seeds; their mean is the reference image."""


def errors(images: Sequence[Image], reference: Halves, camera: Camera) -> dict[str, float]:
    """Errors of images that differ in their seeds only, by the formulas of this module.

    Args:
        images: radiances (H, W, 3), at least two.
        reference: what they are compared with.
        camera: that sees them.

    Returns:
        rmse, noise and systematic in levels of 255; systematic_limit, two standard errors of the squared systematic
        error, below which it cannot be told from 0; bias_percent and its standard error bias_se_percent.
    """
    seen = np.stack([levels(image, camera) for image in images])
    first, second = (levels(half, camera) for half in reference)
    own = (first - second) ** 2 / 4
    variance = seen.var(axis=0, ddof=1)
    square = ((seen - (first + second) / 2) ** 2).mean(axis=0) - own
    # Of Gaussian noise E s^4 = (R + 1) / (R - 1) sigma^4 and E own^2 = 3 tau^4.
    r = len(images)
    spread = 2 * variance**2 * (r - 1) / (r + 1) / (r * (r - 1)) + 4 * variance * own / r + 4 * own**2 / 3
    correlated = max(1.0, 2 * math.pi * camera.blur_px**2)
    bias, bias_se = _bias(images, reference, camera)
    return {
        "rmse": math.sqrt(max(square.mean(), 0.0)),
        "noise": math.sqrt(variance.mean()),
        "systematic": math.sqrt(max((square - variance).mean(), 0.0)),
        "systematic_limit": math.sqrt(2 * math.sqrt(correlated * spread.mean() / spread[:, :, 0].size)),
        "bias_percent": 100 * bias,
        "bias_se_percent": 100 * bias_se,
    }


def rendered(renderer: Renderer, positions: Points, seeds: Sequence[int]) -> tuple[list[Image], dict[str, float]]:
    """Images of one state (v, 3) mm, and the medians of a frame's wall time and processor time of all threads, s."""
    renderer.radiance(positions, 0)  # compiles
    images, seconds, processor = [], [], []
    for seed in seeds:
        started, worked = time.perf_counter(), time.process_time()
        images.append(renderer.radiance(positions, seed))
        seconds.append(time.perf_counter() - started)
        processor.append(time.process_time() - worked)
    return images, {"seconds": median(seconds), "processor_s": median(processor)}


def levels(radiance: Image, camera: Camera) -> FloatArray:
    """A radiance as the camera sees it: (H, W, 3) float64, levels of 255."""
    return LEVELS * encoded(expected_signal(radiance, camera), camera)


def reference_noise(reference: Halves, camera: Camera) -> float:
    """Root mean square of the reference's own noise, levels of 255."""
    first, second = (levels(half, camera) for half in reference)
    return float(np.sqrt(np.mean((first - second) ** 2)) / 2)


def camera_noise(radiance: Image, camera: Camera) -> float:
    """Root mean square of the camera's own noise in one image, quantisation and clipping included, levels of 255."""
    image = camera_image(radiance, camera, np.random.default_rng(0))
    values = image * (LEVELS / np.iinfo(image.dtype).max)
    return float(np.sqrt(np.mean((values - levels(radiance, camera)) ** 2)))


def _bias(images: Sequence[Image], reference: Halves, camera: Camera) -> tuple[float, float]:
    """Mean relative error of the linear signal, and its standard error."""
    sharp = camera.model_copy(update={"blur_px": 0.0})
    grey = np.stack([expected_signal(image, sharp).mean(axis=2) for image in images])
    first, second = (expected_signal(half, sharp).mean(axis=2) for half in reference)
    truth = (first + second) / 2
    variance = grey.var(axis=0, ddof=1).mean() / len(grey) + ((first - second) ** 2).mean() / 4
    return float(grey.mean() / truth.mean() - 1), float(math.sqrt(variance / truth.size) / truth.mean())
