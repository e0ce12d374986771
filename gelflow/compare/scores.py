"""Scores of methods: of one pair, and means over pairs."""

import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from statistics import median
from typing import Any

import numpy as np

from gelflow.arrays import FlowArray, ImageArray, MapArray
from gelflow.baselines.exact import ExactFlow
from gelflow.compare.dots import dot_distance, find_dots
from gelflow.compare.metrics import closure, endpoint_error, flow_errors, image_similarity, marker_distance
from gelflow.compare.strata import Stratum, pair_strata
from gelflow.data.pairs import PairDataset
from gelflow.data.record import PatternedScene
from gelflow.errors import InputError, NothingFoundError
from gelflow.files.exr import FlowField
from gelflow.hardware import hardware
from gelflow.methods.method import Method, uncertainty
from gelflow.methods.name import MethodName
from gelflow.models.uncertainty import CERTAIN_PX
from gelflow.models.working_size import unknown_px


@dataclass(frozen=True, kw_only=True)
class Measures:
    """How good a flow is; None where a pair has no exact flow or markers.

    Attributes:
        psnr_db, ssim: Of image 1 and image 2 warped by the flow.
        endpoint_error_px, median_error_px: Mean and median endpoint error.
        outliers_1px, outliers_01px: Share of pixels with an endpoint error above 1 px and 0.1 px.
        marker_distance_px: Median distance to tracked dots.
        dot_distance_px, dot_p90_px, own_dots: See `gelflow.compare.dots.DotDistance`; where there is no exact flow and
            both images show a pattern of dots.
        closure_px, closure_p90_px: Median and 90th percentile of the closure; where there is no exact flow.
        unknown, certain: Share of pixels whose sigma is above `working_size.unknown_px`, and up to 0.1 px.
        calibration: Share of the certain pixels whose endpoint error is within sigma; 0.68 if sigma is right.
    """

    psnr_db: float
    ssim: float
    endpoint_error_px: float | None = None
    median_error_px: float | None = None
    outliers_1px: float | None = None
    outliers_01px: float | None = None
    marker_distance_px: float | None = None
    dot_distance_px: float | None = None
    dot_p90_px: float | None = None
    own_dots: float | None = None
    closure_px: float | None = None
    closure_p90_px: float | None = None
    unknown: float | None = None
    certain: float | None = None
    calibration: float | None = None


@dataclass(frozen=True, kw_only=True)
class PairScore(Measures):
    """How one method did on one pair.

    Attributes:
        method, pair: Their names.
        scene: Of a synthetic pair, or None.
        motion_px: Mean length of the true motion over the compared pixels.
        seconds: Run time of the method, images in memory to flow in memory.
        processor_seconds: Time of all its threads on the processor meanwhile; unlike `seconds` it does not grow with
            what else the machine does.
        device: What the method ran on.
        on_gpu: Whether that was a CUDA device.
        strata: Its endpoint errors sorted by what they may depend on.
    """

    method: MethodName
    pair: str
    scene: PatternedScene | None
    motion_px: float | None = None
    seconds: float
    processor_seconds: float
    device: str
    on_gpu: bool
    strata: tuple[Stratum, ...] = ()


@dataclass(frozen=True, kw_only=True)
class MethodScore(Measures):
    """Means over pairs, pair by pair with equal weight; times are medians. None where no pair has the number."""

    method: MethodName
    pairs: int
    seconds: float
    processor_seconds: float
    device: str
    on_gpu: bool

    @property
    def cost_seconds(self) -> float:
        """What a pair costs: time on a GPU as it passes, on a processor that of one core, whatever else it does."""
        return self.seconds if self.on_gpu else self.processor_seconds


def score_pair(method: Method, dataset: PairDataset, index: int) -> PairScore:
    """Runs a method on one pair and scores it; where it finds nothing to follow, it is scored as no motion.

    Otherwise a method that gives up would look better than one that tries. InputError where the pair cannot be read, or
    the method cannot work on it; the message names the pair.
    """
    record = dataset.records[index]
    image1, image2 = dataset.images(index)
    truth, markers = dataset.truth(index), dataset.markers(index)
    started, busy = time.perf_counter(), time.process_time()
    try:
        flow = method.of(truth) if isinstance(method, ExactFlow) else _estimate(method, image1, image2)
    except InputError as error:
        raise InputError(f"{dataset.source}, pair {record.name}, {method.name}: {error}") from error
    seconds, processor_seconds = time.perf_counter() - started, time.process_time() - busy
    psnr_db, ssim = image_similarity(image1, image2, flow)
    device = str(getattr(method, "device", "cpu"))
    sigma = uncertainty(flow, image1, image2, device)[0]
    try:
        if truth is None:
            errors = _without_truth(method, image1, image2, flow)
        else:
            errors = _errors(flow, truth, record.scene, sigma)
    except InputError as error:
        raise InputError(f"{record.flow or record.name}: {error}") from error
    return PairScore(
        method=method.name,
        pair=record.name,
        scene=record.scene,
        psnr_db=psnr_db,
        ssim=ssim,
        marker_distance_px=None if markers is None else marker_distance(flow, markers),
        seconds=seconds,
        processor_seconds=processor_seconds,
        device=hardware(device),
        on_gpu=device == "cuda",
        unknown=float((sigma > unknown_px(*sigma.shape)).mean()),
        certain=float((sigma <= CERTAIN_PX).mean()),
        **errors,
    )


def _estimate(method: Method, image1: ImageArray, image2: ImageArray) -> FlowArray:
    try:
        return method.flow(image1, image2)
    except NothingFoundError:
        return np.zeros((*image1.shape[:2], 2), np.float32)


def _without_truth(method: Method, image1: ImageArray, image2: ImageArray, flow: FlowArray) -> dict[str, Any]:
    """The fields of a score that take the place of errors where there is no exact flow."""
    found: dict[str, Any] = {}
    dots1, dots2 = find_dots(image1), find_dots(image2)
    distance = None if dots1 is None or dots2 is None else dot_distance(flow, dots1, dots2)
    if distance is not None:
        found = {"dot_distance_px": distance.median_px, "dot_p90_px": distance.p90_px, "own_dots": distance.own}
    gap = closure(flow, _estimate(method, image2, image1))
    if np.isfinite(gap).any():
        found["closure_px"], found["closure_p90_px"] = (float(q) for q in np.nanpercentile(gap, (50, 90)))
    return found


def _errors(flow: FlowArray, truth: FlowField, scene: PatternedScene | None, sigma: MapArray) -> dict[str, Any]:
    """The fields of a score that need the exact flow."""
    errors: dict[str, Any] = flow_errors(flow, truth.flow, truth.visible)
    compared = np.logical_and(truth.visible, np.isfinite(truth.flow).all(axis=-1))
    motion = np.hypot(truth.flow[..., 0], truth.flow[..., 1])[compared]
    error, certain = endpoint_error(flow, truth.flow), compared & (sigma <= CERTAIN_PX)
    return errors | {
        "calibration": float((error <= sigma)[certain].mean()) if certain.any() else None,
        "motion_px": float(motion.mean(dtype=np.float64)),
        "strata": pair_strata(error, truth.flow, compared, truth.contact, scene),
    }


def evaluate(
    method: Method, dataset: PairDataset, progress: Callable[[PairScore], None] | None = None
) -> list[PairScore]:
    """Scores a method on all pairs, in order; `progress` is called after each.

    The first pair is estimated once before, untimed: libraries and devices take longer the first time.
    """
    scores = []
    with suppress(InputError):  # is raised again, with the pair's name, when the pair is scored
        method.flow(*dataset.images(0))
    for index in range(len(dataset)):
        scores.append(score_pair(method, dataset, index))
        if progress:
            progress(scores[-1])
    return scores


def summarise(scores: Sequence[PairScore]) -> list[MethodScore]:
    """Means per method, in the order in which the methods appear."""
    means, measures = [], [field.name for field in fields(Measures)]
    for name in dict.fromkeys(score.method for score in scores):
        own = [score for score in scores if score.method == name]
        values: dict[str, Any] = {field: _mean([getattr(score, field) for score in own]) for field in measures}
        values |= {field: median(getattr(score, field) for score in own) for field in ("seconds", "processor_seconds")}
        means.append(MethodScore(method=name, pairs=len(own), device=own[0].device, on_gpu=own[0].on_gpu, **values))
    return means


def _mean(values: Sequence[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return math.fsum(present) / len(present) if present else None
