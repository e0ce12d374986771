"""Scoring a method on image pairs."""

import math
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from statistics import fmean, median

import numpy as np

from gelflow.baselines.method import Method
from gelflow.data.pairs import PairDataset
from gelflow.errors import InputError
from gelflow.metrics import endpoint_error, flow_errors, image_similarity, marker_distance
from gelflow.strata import Stratum, pair_strata


@dataclass(frozen=True)
class PairScore:
    """How one method did on one pair; None where the pair has no exact flow or no markers.

    Attributes:
        method, pair: Their names.
        psnr_db, ssim: Of image 1 and image 2 warped by the flow.
        endpoint_error_px, median_error_px: Mean and median endpoint error.
        outliers_1px, outliers_01px: Share of pixels with an endpoint error above 1 px and 0.1 px.
        marker_distance_px: Median distance to tracked dots.
        seconds: Run time of the method, images in memory to flow in memory.
        strata: Its endpoint errors sorted by what they may depend on.
    """

    method: str
    pair: str
    psnr_db: float
    ssim: float
    endpoint_error_px: float | None
    median_error_px: float | None
    outliers_1px: float | None
    outliers_01px: float | None
    marker_distance_px: float | None
    seconds: float
    strata: tuple[Stratum, ...] = ()


@dataclass(frozen=True)
class MethodScore:
    """Means over pairs, pair by pair with equal weight; `seconds` is the median. None where no pair has the number."""

    method: str
    pairs: int
    psnr_db: float
    ssim: float
    endpoint_error_px: float | None
    median_error_px: float | None
    outliers_1px: float | None
    outliers_01px: float | None
    marker_distance_px: float | None
    seconds: float


def score_pair(method: Method, dataset: PairDataset, index: int) -> PairScore:
    """Runs a method on one pair and scores it.

    Raises:
        InputError: The pair cannot be read, or the method cannot work on it; the message names the pair.
    """
    name = dataset.records[index].name
    image1, image2 = dataset.images(index)
    truth, markers = dataset.truth(index), dataset.markers(index)
    started = time.perf_counter()
    try:
        flow = method.flow(image1, image2)
    except InputError as error:
        raise InputError(f"{dataset.source}, pair {name}, {method.name}: {error}") from error
    seconds = time.perf_counter() - started
    similarity = image_similarity(image1, image2, flow)
    try:
        errors = flow_errors(flow, truth.flow, truth.visible) if truth else None
    except InputError as error:
        raise InputError(f"{dataset.records[index].flow}: {error}") from error
    strata: tuple[Stratum, ...] = ()
    if truth is not None:
        compared = np.logical_and(truth.visible, np.isfinite(truth.flow).all(axis=-1))
        scene = dataset.records[index].scene
        strata = pair_strata(endpoint_error(flow, truth.flow), truth.flow, compared, truth.contact, scene)
    return PairScore(
        method=method.name,
        pair=name,
        psnr_db=similarity[0],
        ssim=similarity[1],
        endpoint_error_px=errors.mean_px if errors else None,
        median_error_px=errors.median_px if errors else None,
        outliers_1px=errors.outliers_1px if errors else None,
        outliers_01px=errors.outliers_01px if errors else None,
        marker_distance_px=marker_distance(flow, markers) if markers is not None else None,
        seconds=seconds,
        strata=strata,
    )


def evaluate(
    method: Method, dataset: PairDataset, progress: Callable[[PairScore], None] | None = None
) -> list[PairScore]:
    """Scores a method on all pairs, in order; `progress` is called after each.

    The first pair is estimated once before, untimed: libraries and devices take longer the first time.

    Raises:
        InputError: A pair cannot be read, or the method cannot work on it.
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
    names = dict.fromkeys(score.method for score in scores)
    return [_mean_score(name, [score for score in scores if score.method == name]) for name in names]


def _mean_score(name: str, scores: Sequence[PairScore]) -> MethodScore:
    return MethodScore(
        method=name,
        pairs=len(scores),
        psnr_db=fmean(s.psnr_db for s in scores),
        ssim=fmean(s.ssim for s in scores),
        endpoint_error_px=_mean(s.endpoint_error_px for s in scores),
        median_error_px=_mean(s.median_error_px for s in scores),
        outliers_1px=_mean(s.outliers_1px for s in scores),
        outliers_01px=_mean(s.outliers_01px for s in scores),
        marker_distance_px=_mean(s.marker_distance_px for s in scores),
        seconds=median(s.seconds for s in scores),
    )


def _mean(values: Iterable[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return math.fsum(present) / len(present) if present else None
