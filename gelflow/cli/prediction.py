"""The commands `predict`, `live` and `export`."""

from __future__ import annotations

import csv
import json
import math
import os
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, nullcontext
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from gelflow.cli.options import (
    METHODS,
    AsJson,
    Device,
    OnDevice,
    Out,
    Places,
    Registered,
    Registration,
    ShippedOrFile,
    Size,
    parse_size,
    whole,
)
from gelflow.errors import InputError, printable

if TYPE_CHECKING:
    from gelflow.methods.method import Method
    from gelflow.predict.live import LiveFlow
    from gelflow.predict.page import Page
    from gelflow.predict.prediction import Motion, Prediction

SCALE_DECAY = 0.9
"""Share of its scale that a live picture keeps at least from one picture to the next."""
PICTURE_S = 0.08
"""Least time from one picture of the page to the next: drawing takes more than half as long as the flow."""
InPlace = Annotated[str | None, Parameter(help=f"In place of the network: {METHODS}.")]


def predict(
    inputs: Annotated[list[Path], Parameter(help="Two images, one video or folder of frames, or one set of pairs.")],
    /,
    *,
    out: Out,
    weights: ShippedOrFile = None,
    method: InPlace = None,
    registration: Registration = None,
    reference: Annotated[
        Literal["first", "previous"], Parameter(help="Of a video: flow from its first or from the previous frame.")
    ] = "first",
    every: Annotated[int, Parameter(converter=whole(1), help="Of a video: take every n-th frame.")] = 1,
    markers: Annotated[
        bool, Parameter(negative=(), help="Of a video: write the motion of the first frame's dots to markers.csv.")
    ] = False,
    scene: Places = None,
    size: Size = None,
    device: OnDevice = "auto",
    as_json: AsJson = False,
) -> int:
    """Writes the flow of pairs of images (EXR, .flo and a picture) or of a video (EXR, motion.csv and a video)."""
    from gelflow.data.open import holds_pairs
    from gelflow.data.pairs import PairDataset
    from gelflow.predict.prediction import predict_pair, predict_pairs, predict_video
    from gelflow.terminal import progress
    from gelflow.track.places import read_places

    if len(inputs) not in (1, 2):
        raise InputError(
            f"{len(inputs)} inputs given; allowed: two images, one video or folder of frames, or one set of pairs"
        )
    for path in inputs:
        if not path.exists():
            raise InputError(f"{path}: there is no such file or folder")
    places = read_places(scene, markers)
    estimator = _estimator(weights, method, registration, size, device)
    paired = len(inputs) == 2 or holds_pairs(inputs[0])
    if paired and (reference, every, markers) != ("first", 1, False):
        raise InputError("--reference, --every and --markers are for a video or a folder of frames, not for pairs")
    if len(inputs) == 2:
        result = predict_pair(estimator, inputs[0], inputs[1], out)
    elif paired:
        with progress("pairs", not as_json) as advance:
            result = predict_pairs(estimator, PairDataset(inputs[0]), out, lambda n, total: advance(n, total, ""))
    else:
        with progress("frames, then overlay", not as_json) as advance:
            result = predict_video(
                estimator, inputs[0], out, reference, every, lambda n, total: advance(n, total, ""), markers, places
            )
    if result.lost:
        words = f"about {result.lost} frames at its end do not decode (truncated or damaged)"
        print(f"gelflow: {inputs[0]}: {words}", file=sys.stderr)
    _show(result, str(estimator.name), as_json)
    return 0


def live(
    source: Annotated[str, Parameter(help="A camera's number, such as 0, a stream's address or a video file.")],
    /,
    *,
    weights: ShippedOrFile = None,
    method: InPlace = None,
    registration: Registration = None,
    reference: Annotated[
        Literal["first", "previous"], Parameter(help="Flow from the first or from the previous frame.")
    ] = "first",
    markers: Annotated[
        Path | None, Parameter(help="File to write the motion of the first frame's dots to, as it comes (CSV).")
    ] = None,
    out: Annotated[
        Path | None, Parameter(help="Folder to record to what predict writes: flow (EXR), motion.csv, a video.")
    ] = None,
    scene: Places = None,
    size: Size = None,
    device: OnDevice = "auto",
    port: Annotated[int | None, Parameter(converter=whole(0), help="Show the flow at http://127.0.0.1:PORT.")] = None,
    seconds: Annotated[
        float, Parameter(help="Stop at the first frame after so many seconds; default: with the source.")
    ] = math.inf,
    as_json: AsJson = False,
) -> int:
    """Prints the motion of a running camera, a line for each frame, until the camera or Ctrl-C ends it.

    Frames that come while one is computed are left out. A camera that goes away is waited for. With --json each line is
    JSON. Latency and rate are those of the last 300 frames.
    """
    from gelflow.predict.live import Pace, follow
    from gelflow.predict.page import Page
    from gelflow.predict.recording import Recording
    from gelflow.track.markers import marker_rows, marker_table
    from gelflow.track.places import read_places

    if not seconds >= 0:
        raise InputError(f"--seconds {seconds:g}: allowed are 0 and more")
    places = read_places(scene, markers is not None)
    estimator = _estimator(weights, method, registration, size, device)
    page = None if port is None else Page(port)
    if page:
        print(f"gelflow: {estimator.name} at {page.address}", file=sys.stderr, flush=True)
    pace, started = Pace(), time.perf_counter()
    drawn, drawn_at = Future[float](), -math.inf
    drawn.set_result(0.0)
    marked = markers is not None or (page is not None and reference == "first")
    try:
        with ThreadPoolExecutor(1) as artist, closing(follow(estimator, source, reference, marked, places)) as flows:
            first = next(flows)  # a source that does not open replaces no files
            with (
                nullcontext() if out is None else closing(Recording(out)) as recording,
                nullcontext() if markers is None else markers.open("w", newline="", encoding="utf-8") as table,
            ):
                if table:
                    csv.writer(table).writerow(marker_table(places))
                for flow in chain([first], flows):
                    pace.add(flow)
                    motion = flow.motion
                    if recording:
                        recording.add(flow.frame, flow.found, motion)
                    if table and flow.markers is not None:
                        csv.writer(table).writerows(marker_rows(motion.frame, motion.time_s, flow.markers, places))
                        table.flush()
                    line = {**asdict(motion), "latency_s": flow.latency_s, "left_out": flow.left_out}
                    words = f"frame {motion.frame}: {_words(motion)}; {pace}"
                    if page and drawn.done() and time.perf_counter() > drawn_at + PICTURE_S:
                        drawn_at = time.perf_counter()
                        drawn = artist.submit(show_live, page, flow, words, drawn.result())
                    print(json.dumps(line) if as_json else words, flush=True)
                    if time.perf_counter() - started >= seconds:
                        break
    except KeyboardInterrupt:
        pass
    except BrokenPipeError:  # whoever read the lines has enough of them
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    finally:
        if page:
            page.close()
    print(f"gelflow: {pace}", file=sys.stderr)
    return 0


def show_live(page: Page, flow: LiveFlow, words: str, scale: float) -> float:
    """Shows a frame; returns the scale of its picture, px, which goes on from that of the picture before."""
    from gelflow.files.image import shown
    from gelflow.models.working_size import unknown_px
    from gelflow.predict.pictures import certain, draw_markers, draw_overlay, draw_sigma, robust_scale, round_up

    known = certain(flow.found.flow, flow.found.sigma)
    scale = max(SCALE_DECAY * scale, robust_scale(known))
    seen = [] if flow.markers is None else [marker.item()[:-1] for marker in flow.markers if marker["visible"]]
    picture = draw_overlay(draw_markers(shown(flow.frame), seen), known, round_up(scale))
    page.show(picture, draw_sigma(flow.found.sigma, unknown_px(*flow.found.sigma.shape)), words, seen)
    return scale


def _estimator(
    weights: Path | None, method: str | None, registration: Registered | None, size: str | None, device: Device
) -> Method:
    """The network or classical method that the options name."""
    from gelflow.baselines import named_methods
    from gelflow.methods.learned import open_network
    from gelflow.models.weights import weights_file

    if method is None:
        return open_network(weights_file(weights), None, parse_size(size), device, registration)
    if weights is not None or size is not None:
        raise InputError("give either --weights FILE and --size (of a network) or --method NAME (a classical one)")
    if registration is not None:
        raise InputError(
            "--registration: is for --weights of GelFlow; "
            "of DIS there are --method dis-motion, dis-both, dis-brightness"
        )
    return named_methods([method], device)[0]


def _words(motion: Motion) -> str:
    return (
        f"mean motion {motion.mean_px:.3g} px, 95th percentile {motion.p95_px:.3g} px; "
        f"unknown on {motion.unknown:.0%} of the picture"
    )


def _show(result: Prediction, name: str, as_json: bool) -> None:
    if as_json:
        motions = [asdict(motion) for motion in result.motions]
        print(json.dumps({"files": [str(file) for file in result.files], "motions": motions, "lost": result.lost}))
        return
    largest = max(result.motions, key=lambda motion: motion.p95_px)
    where = f" in number {largest.frame} ({largest.file}), where most moves," if len(result.motions) > 1 else ""
    print(printable(f"{name}:{where} {_words(largest)}"))
    shown = result.files if len(result.files) <= 6 else [result.files[0], "...", *result.files[-3:]]
    print(printable(f"written: {', '.join(str(file) for file in shown)}"))


def export(
    weights: Annotated[Path, Parameter(help="File of weights; best: those that come with the package.")],
    /,
    *,
    out: Annotated[Path, Parameter(help="File to write, ending in .onnx.")],
    size: Annotated[str | None, Parameter(help="ROWSxCOLUMNS of the images; default: as in training.")] = None,
) -> int:
    """Writes a network for images of one size as ONNX: image1 and image2 in, flow out."""
    from gelflow.models.onnx import export_onnx
    from gelflow.models.weights import weights_file

    rows, columns = export_onnx(weights_file(weights), out, parse_size(size))
    print(f"written: {out} (image1, image2: 1x3x{rows}x{columns} in [0, 1]; flow: 1x2x{rows}x{columns} in px)")
    return 0
