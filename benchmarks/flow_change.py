r"""How much render noise changes the flow that a method measures on an image pair.

S images of the first state and S of the second make S² pairs. Each image gets camera noise, the same when the renderer
changes, and so does the nearly noiseless image that it is compared with: the difference between the flows measured on
both pairs comes from the renderer alone. The pairs share images; the standard error of their mean change is the
jackknife's, which leaves out the pairs of one seed at a time:

.. math::  se^2 = \frac{S - 1}{S} \sum_k (m_{(k)} - \bar m_{(\cdot)})^2 .

Errors are taken over the pixels whose point is visible in both images. Where there is no texture a method may find
anything, and such pixels rule the mean; the median pixel tells of the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.pressed_gel import View
from gelflow.methods.method import Method
from synth.arrays import BoolArray, FloatArray, Image
from synth.errors import InputError
from synth.flow.exact import exact_flow
from synth.flow.field import FlowArray
from synth.flow.view import View as Tracer
from synth.optics import Optics
from synth.render.camera_image import camera_image
from synth.scene import Camera

NOISE_INSTANCES = 4
"""Of the camera's noise, for each image."""
_SEED = 10**6
AnyFlow = FloatArray | FlowArray
Images = Sequence[Sequence[Image]]
"""Radiances (H, W, 3), or (H, W, 1) of grey cameras: S of the first state and S of the second."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Exact forward flow (H, W, 2) px from the undeformed to the pressed gel, and the pixels (H, W) that count."""

    flow: FloatArray
    counts: BoolArray

    @classmethod
    def of(cls, view: View) -> "Truth":
        """Exact flow of a press.

        Raises:
            InputError: No point is visible in both images.
        """
        found = exact_flow(Tracer(view.surface, Optics.of(view.sensor)), *view.states, backward=False)
        flow = found.forward.astype(np.float64)
        counts = (found.forward_visible > 0) & np.isfinite(flow).all(axis=2)
        if not counts.any():
            raise InputError("no point of the gel is visible in both images of the pair: choose another --seed")
        return cls(flow, counts)

    def distances(self, first: AnyFlow, second: AnyFlow) -> FloatArray:
        """Mean and median distance in px of two flows (H, W, 2) over the pixels that count."""
        distances = np.linalg.norm(first - second, axis=2)[self.counts]
        return np.array([distances.mean(), np.median(distances)])


def changes(images: Images, compared: Images, camera: Camera, truth: Truth, method: Method) -> dict[str, float]:
    """What a method finds on the pairs of `images`, against what it finds on those of `compared`.

    Args:
        images: S of each state.
        compared: nearly noiseless ones in the same order.
        camera: whose noise they get.
        truth: exact flow of the pair.
        method: that measures flow.

    Returns:
        In px, `median_` for the median pixel instead of the mean: error_px of the measured flow; change_px, how much
        larger it is than on `compared`, and its standard error change_se_px, NaN for one pair; difference_px between
        the two measured flows.
    """
    count = len(images[0])
    instances = NOISE_INSTANCES if camera.read_noise or camera.shot_noise else 1
    values = np.zeros((instances, 3, count, count, 2))
    for instance in range(instances):
        noisy, clean = (_photographs(each, camera, instance) for each in (images, compared))
        for i, j in np.ndindex(count, count):
            flow, aim = (method.flow(first[i], second[j]) for first, second in (noisy, clean))
            error, without = truth.distances(flow, truth.flow), truth.distances(aim, truth.flow)
            values[instance, :, i, j] = error, error - without, truth.distances(flow, aim)
    errors, changed, apart = values.mean(axis=0)
    row: dict[str, float] = {}
    for k, prefix in enumerate(("", "median_")):
        row |= {
            f"{prefix}error_px": float(errors[..., k].mean()),
            f"{prefix}change_px": float(changed[..., k].mean()),
            f"{prefix}change_se_px": jackknife(changed[..., k]) if count > 1 else float("nan"),
            f"{prefix}difference_px": float(apart[..., k].mean()),
        }
    return row


def jackknife(values: FloatArray) -> float:
    """Standard error of the mean of values (S, S) of which row k and column k belong to seed k."""
    count = len(values)
    left = [np.delete(np.delete(values, k, axis=0), k, axis=1).mean() for k in range(count)]
    return float(np.sqrt((count - 1) * np.var(left)))


def _photographs(images: Images, camera: Camera, instance: int) -> list[list[Image]]:
    """What a method gets: (H, W, 3) float32 in [0, 1]."""
    taken = []
    for side, state in enumerate(images):
        noise = [np.random.default_rng([_SEED, side, k, instance]) for k in range(len(state))]
        pixels = [camera_image(image, camera, rng) for image, rng in zip(state, noise, strict=True)]
        full = [(p / np.iinfo(p.dtype).max).astype(np.float32) for p in pixels]
        taken.append([np.repeat(p, 3 // p.shape[2], axis=2) for p in full])
    return taken
