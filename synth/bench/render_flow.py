r"""What render noise does to a flow method: OpenCV's DIS (medium) on a pair rendered with more and more samples.

Kroeger, Timofte, Dai and Van Gool, Fast Optical Flow Using Dense Inverse Search, ECCV 2016.

Each state is rendered S times with other seeds and gets camera noise of its own each time; every first picture is
paired with every second, and with camera noise each pair counts by its mean over NOISE_DRAWS draws of that. A picture
keeps its camera noise when the number of samples changes, so that the change of the endpoint error comes from the
renderer alone. It is held against the error on nearly noiseless pictures, the means of
the other S - 1 pictures with most samples, with the same camera noise. The S² pairs share their pictures; the standard
error of their mean is the jackknife's, leaving out the pairs of one seed at a time,

.. math::  se^2 = \frac{S - 1}{S} \sum_k (m_{(k)} - \bar m_{(\cdot)})^2 .

Endpoint errors and differences are means over all pixels whose point is visible in the second picture. Where there is
no texture a method may find anything, and such pixels rule the mean; the median pixel tells of the others.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from synth.arrays import BoolArray, FloatArray, Image
from synth.bench.render_measure import Say
from synth.bench.render_subject import View
from synth.errors import InputError
from synth.flow.exact import exact_flow
from synth.flow.field import FlowArray
from synth.optics import Optics
from synth.render.camera_image import camera_image
from synth.render.renderer import full_grid
from synth.render.variant import Variant
from synth.scene import Camera, Render

FLOW_SAMPLES = (1, 4, 16, 36, 64, 144)
"""Asked for."""
NOISE_DRAWS = 4
"""Of the camera's noise for each picture."""
SEEN_PX = 0.01
"""A change of the endpoint error that counts."""
_SEEDS = 10**6
"""First seed of this part; the errors of pictures have the smaller ones."""

Grey: TypeAlias = NDArray[np.uint8]
"""(H, W)."""
Flows: TypeAlias = list[list[FlowArray]]
"""By the seeds of the first and the second picture."""


@dataclass(frozen=True, eq=False)
class Effect:
    """DIS on pairs with one number of samples; arrays (S, S), first picture by second.

    Attributes:
        samples: per pixel.
        camera_noise: whether there was any; quantisation there is always.
        error_px: endpoint error.
        change_px: of it from that on nearly noiseless pictures.
        typical_px: endpoint error of the median pixel.
        typical_change_px: of that.
        difference_px: of the measured flow from that on nearly noiseless pictures.
    """

    samples: int
    camera_noise: bool
    error_px: FloatArray
    change_px: FloatArray
    typical_px: FloatArray
    typical_change_px: FloatArray
    difference_px: FloatArray

    @property
    def median_px(self) -> float:
        """Of the endpoint error."""
        return float(np.median(self.error_px))

    @property
    def quartiles_px(self) -> tuple[float, float]:
        """Of the endpoint error."""
        lower, upper = np.percentile(self.error_px, [25, 75])
        return float(lower), float(upper)

    @property
    def median_difference_px(self) -> float:
        """Of the measured flows."""
        return float(np.median(self.difference_px))

    @property
    def change(self) -> tuple[float, float]:
        """Mean change of the endpoint error and its standard error."""
        return float(self.change_px.mean()), jackknife(self.change_px)

    @property
    def typical_change(self) -> tuple[float, float]:
        """The same of the median pixel's."""
        return float(self.typical_change_px.mean()), jackknife(self.typical_change_px)


def is_unseen(change: tuple[float, float]) -> bool:
    """Whether a change is below SEEN_PX, two standard errors allowed for."""
    mean, error = change
    return abs(mean) + 2 * error <= SEEN_PX


def is_seen(change: tuple[float, float]) -> bool:
    """Whether a change is above SEEN_PX, two standard errors allowed for."""
    mean, error = change
    return abs(mean) - 2 * error > SEEN_PX


@dataclass(frozen=True, eq=False)
class Truth:
    """Exact forward flow (H, W, 2) px, and the pixels (H, W) that count."""

    flow: FloatArray
    counts: BoolArray

    def error_px(self, measured: FlowArray) -> float:
        """Mean endpoint error of a measured flow (H, W, 2)."""
        return self.distance_px(measured, self.flow)

    def typical_px(self, measured: FlowArray) -> float:
        """Endpoint error of the median pixel."""
        return float(np.median(np.linalg.norm(measured - self.flow, axis=2)[self.counts]))

    def distance_px(self, first: FlowArray, second: FlowArray | FloatArray) -> float:
        """Mean distance of two flows (H, W, 2)."""
        return float(np.linalg.norm(first - second, axis=2)[self.counts].mean())

    @property
    def mean_px(self) -> float:
        """Mean length of the motion."""
        return float(np.linalg.norm(self.flow, axis=2)[self.counts].mean())

    @property
    def largest_px(self) -> float:
        """Largest length of the motion."""
        return float(np.linalg.norm(self.flow, axis=2)[self.counts].max())


def truth(view: View) -> Truth:
    """Exact flow from the undeformed to the pressed gel.

    Raises:
        InputError: nothing is visible in both.
    """
    camera, surface, optics = view.sensor.camera, view.surface, Optics.of(view.sensor)
    field = exact_flow(surface, surface.material, view.pressed, optics, camera.width, camera.height, backward=False)
    flow = field.forward.astype(np.float64)
    counts = (field.forward_visible > 0) & np.isfinite(flow).all(axis=2)
    if not counts.any():
        raise InputError("no point of the gel is visible in both pictures of the pair: choose another --seed")
    return Truth(flow, counts)


def effects(
    view: View,
    exact: Truth,
    variant: Variant,
    max_depth: int,
    seeds: int,
    say: Say = lambda _: None,
    wanted: Sequence[int] = FLOW_SAMPLES,
) -> Iterator[Effect]:
    """DIS on pairs with more and more samples, without and with the camera's noise.

    Args:
        view: sensor and press.
        exact: from `truth`.
        variant: that renders.
        max_depth: of the paths.
        seeds: of each picture, at least two.
        say: told what was done.
        wanted: samples per pixel.
    """
    lights = sum(light.power > 0 for light in view.sensor.lights)
    ladder = list(dict.fromkeys(full_grid(asked, lights) for asked in sorted(wanted)))
    own = view.sensor.camera
    cameras = {False: own.model_copy(update={"read_noise": 0.0, "shot_noise": 0.0}), True: own}
    best = _rendered(view, variant, max_depth, ladder[-1], seeds)
    draws = {False: 1, True: NOISE_DRAWS}
    aimed = _others(best)
    aims = {noise: [_flows(aimed, camera, m) for m in range(draws[noise])] for noise, camera in cameras.items()}
    for samples in ladder:
        pictures = best if samples == ladder[-1] else _rendered(view, variant, max_depth, samples, seeds)
        for noise, camera in cameras.items():
            each = [_compared(_flows(pictures, camera, m), aim, exact) for m, aim in enumerate(aims[noise])]
            error, change, typical, typical_change, difference = np.mean(each, axis=0)
            yield Effect(samples, noise, error, change, typical, typical_change, difference)
        say(f"flow: {seeds} x {seeds} pairs with {samples} samples a pixel")


def jackknife(values: FloatArray) -> float:
    """Standard error of the mean of values (S, S) of which row k and column k belong to seed k."""
    count = len(values)
    left = [np.delete(np.delete(values, k, axis=0), k, axis=1).mean() for k in range(count)]
    return float(np.sqrt((count - 1) * np.var(left)))


def dis(first: Grey, second: Grey) -> FlowArray:
    """Flow (H, W, 2) px of two grey images (H, W) uint8, by OpenCV's preset "medium"."""
    import cv2

    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return np.asarray(method.calc(first, second, None), dtype=np.float32)


def _rendered(view: View, variant: Variant, max_depth: int, samples: int, seeds: int) -> list[list[Image]]:
    """Radiances of both states, each with seeds that no other number of samples has."""
    renderer = view.renderer(variant, Render(samples_per_pixel=samples, max_depth=max_depth))
    start = _SEEDS + 2 * seeds * samples
    channels = 1 if variant.is_mono else 3  # a grey camera has one noise, not the mean of three
    return [
        [renderer.radiance(positions, start + seeds * side + k)[:, :, :channels] for k in range(seeds)]
        for side, positions in enumerate((view.surface.material, view.pressed))
    ]


def _others(pictures: Sequence[Sequence[Image]]) -> list[list[Image]]:
    """For each picture the mean of the others of its state."""
    sums = [np.sum(state, axis=0, dtype=np.float64) for state in pictures]
    return [
        [((total - one) / (len(state) - 1)).astype(np.float32) for one in state]
        for total, state in zip(sums, pictures, strict=True)
    ]


def _compared(flows: Flows, aims: Flows, exact: Truth) -> FloatArray:
    """(5, S, S) the arrays of `Effect`, in its order, of one draw of the camera's noise."""
    error, aim = (_each(of, exact.error_px) for of in (flows, aims))
    typical, typical_aim = (_each(of, exact.typical_px) for of in (flows, aims))
    pairs = zip(flows, aims, strict=True)
    difference = np.array([[exact.distance_px(a, b) for a, b in zip(*rows, strict=True)] for rows in pairs])
    return np.stack([error, error - aim, typical, typical - typical_aim, difference])


def _flows(pictures: Sequence[Sequence[Image]], camera: Camera, draw: int) -> Flows:
    """Measured flow of every pair."""
    first, second = (
        [_photograph(radiance, camera, (side, k, draw)) for k, radiance in enumerate(state)]
        for side, state in enumerate(pictures)
    )
    return [[dis(a, b) for b in second] for a in first]


def _photograph(radiance: Image, camera: Camera, number: tuple[int, int, int]) -> Grey:
    """What a flow method gets: (H, W) uint8, grey."""
    import cv2

    image = camera_image(radiance, camera, np.random.default_rng([_SEEDS, *number]))
    grey = image[:, :, 0] if image.shape[2] == 1 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.asarray(grey if grey.dtype == np.uint8 else np.round(grey / 257), dtype=np.uint8)


def _each(flows: Flows, measure: Callable[[FlowArray], float]) -> FloatArray:
    return np.array([[measure(flow) for flow in row] for row in flows])
