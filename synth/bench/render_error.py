r"""Error of rendered pictures against a reference that errs, too.

A picture is judged as it is seen: after the lens's blur and vignetting, exposed and encoded, before the camera's noise
and quantisation, in levels of 255. With R pictures :math:`t_k` of other seeds, two halves :math:`a, b` of the reference
:math:`r = (a + b) / 2`, all independent, and means over pixels and channels

.. math::

    noise^2 &= \mathrm{mean}\,\mathrm{var}_k\,t_k, \qquad reference^2 = \mathrm{mean}\,(a - b)^2 / 4 \\
    rmse^2 &= \mathrm{mean}_k\,\mathrm{mean}\,(t_k - r)^2 - reference^2 \\
    systematic^2 &= rmse^2 - noise^2

are unbiased; systematic is what no number of samples removes. The last consists of products of independent errors:
with :math:`\sigma^2 = \mathrm{var}\,t_k` and :math:`\tau^2 = \mathrm{var}\,r` it varies by
:math:`2 \sigma^4 / (R (R - 1)) + 4 \sigma^2 \tau^2 / R + 4 \tau^4` from pixel to pixel where there is nothing
systematic. A Gaussian blur of b px makes :math:`2 \pi b^2` pixels alike in such products; channels count as one.

Encoding is concave, so that noise itself shifts encoded
values; the bias, the mean error over the picture, is therefore taken of the linear signal, before the blur. There the
samples of different pixels are independent, and its standard error over N pixels is

.. math::  se^2 = (\mathrm{mean}\,\mathrm{var}_k\,t_k / R + reference^2) / N .
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from synth.arrays import FloatArray, Image
from synth.render.camera_image import camera_image, expected_signal
from synth.render.sample_count import encoded
from synth.scene import Camera

LEVELS = 255


@dataclass(frozen=True, eq=False)
class Reference:
    """The picture to be held against.

    Attributes:
        halves: radiances (H, W, 3) with independent noise.
        samples: per pixel, of both together.
    """

    halves: tuple[Image, Image]
    samples: int


@dataclass(frozen=True)
class Errors:
    """Of one setting; see the module.

    Attributes:
        rmse, noise, systematic: levels of 255; systematic is 0 where its square came out negative.
        systematic_limit: levels; two standard errors of systematic²: below it systematic is not told from 0.
        bias_percent, bias_se_percent: of the picture's mean signal.
    """

    rmse: float
    noise: float
    systematic: float
    systematic_limit: float
    bias_percent: float
    bias_se_percent: float

    @property
    def has_systematic(self) -> bool:
        """Whether systematic is told from 0."""
        return self.systematic > self.systematic_limit


def errors(pictures: Sequence[Image], reference: Reference, camera: Camera) -> Errors:
    """Errors of pictures that differ in their seeds only.

    Args:
        pictures: radiances (H, W, 3), at least two.
        reference: what they are held against.
        camera: that looks.

    Raises:
        ValueError: fewer than two pictures.
    """
    if len(pictures) < 2:
        raise ValueError(f"{len(pictures)} picture: noise needs at least two with different seeds")
    seen = np.stack([levels(picture, camera) for picture in pictures])
    first, second = (levels(half, camera) for half in reference.halves)
    own = (first - second) ** 2 / 4
    square = ((seen - (first + second) / 2) ** 2).mean(axis=0) - own
    variance = seen.var(axis=0, ddof=1)
    remaining = float((square - variance).mean())
    bias, standard_error = _bias(pictures, reference, camera)
    return Errors(
        rmse=_root(float(square.mean())),
        noise=math.sqrt(variance.mean()),
        systematic=_root(remaining),
        systematic_limit=math.sqrt(2 * _chance(variance, own, len(seen), camera.blur_px)),
        bias_percent=100 * bias,
        bias_se_percent=100 * standard_error,
    )


def reference_noise(reference: Reference, camera: Camera) -> float:
    """Of the reference itself, levels of 255, root mean square."""
    first, second = (levels(half, camera) for half in reference.halves)
    return float(np.sqrt(np.mean((first - second) ** 2)) / 2)


def levels(radiance: Image, camera: Camera) -> FloatArray:
    """A radiance as it is seen: (H, W, 3) float64, levels of 255."""
    return LEVELS * encoded(expected_signal(radiance, camera), camera)


def measured_camera_noise(radiance: Image, camera: Camera, seed: int = 0) -> float:
    """The camera's own, quantisation and clipping included: levels of 255, root mean square, of one photograph."""
    photograph = camera_image(radiance, camera, np.random.default_rng(seed))
    values = photograph * (LEVELS / np.iinfo(photograph.dtype).max)
    return float(np.sqrt(np.mean((values - levels(radiance, camera)) ** 2)))


def slope(samples: Sequence[int], noise: Sequence[float]) -> float:
    """Exponent of noise against samples per pixel, least squares in the logarithms."""
    return float(np.polyfit(np.log(samples), np.log(noise), 1)[0])


def _bias(pictures: Sequence[Image], reference: Reference, camera: Camera) -> tuple[float, float]:
    """Mean relative error of the linear signal, and its standard error."""
    sharp = camera.model_copy(update={"blur_px": 0.0})
    grey = np.stack([expected_signal(picture, sharp).mean(axis=2) for picture in pictures])
    first, second = (expected_signal(half, sharp).mean(axis=2) for half in reference.halves)
    truth = (first + second) / 2
    variance = grey.var(axis=0, ddof=1).mean() / len(grey) + ((first - second) ** 2).mean() / 4
    mean = truth.mean()
    return float((grey.mean() - mean) / mean), float(math.sqrt(variance / truth.size) / mean)


def _chance(variance: FloatArray, own: FloatArray, pictures: int, blur_px: float) -> float:
    """Standard error of systematic² where there is none; see the module.

    Args:
        variance: (H, W, 3) of the pictures, unbiased.
        own: (H, W, 3) squared error of the reference, of one degree of freedom.
        pictures: R.
        blur_px: of the lens.
    """
    r = pictures
    fourth = variance**2 * (r - 1) / (r + 1)  # of Gaussian noise E s^4 = (R + 1) / (R - 1) sigma^4, E own^2 = 3 tau^4
    spread = 2 * fourth / (r * (r - 1)) + 4 * variance * own / r + 4 * own**2 / 3
    alike = max(1.0, 2 * math.pi * blur_px**2)
    return math.sqrt(alike * spread.mean() / spread[:, :, 0].size)


def _root(square: float) -> float:
    return math.sqrt(max(square, 0.0))
