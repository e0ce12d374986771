"""What the commands do once their arguments are known. Imported when one of them runs.

Each function returns the exit status: 0 done, 1 done in part.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import quantiles
from typing import Any

from gelflow.baselines import Method, named_methods
from gelflow.baselines.finetuned import fine_tuned
from gelflow.baselines.learned import Learned, PublishedRaft, open_network
from gelflow.compare import compare
from gelflow.comparison import Comparison
from gelflow.config import Registration
from gelflow.data import PairDataset, join, open_pairs
from gelflow.data.choose import ChoiceConfig
from gelflow.data.extract import extract_pairs, find_recordings
from gelflow.data.pairset import FILE, PairSet, SourceReport
from gelflow.errors import InputError
from gelflow.evaluate import PairScore
from gelflow.export import export_onnx
from gelflow.overrides import train_config
from gelflow.predict import Prediction, Reference, predict_pair, predict_video
from gelflow.report import FILES, devices
from gelflow.report_tables import tables
from gelflow.shipped import weights_file
from gelflow.terminal import progress, show_table

MAXIMUM_PIXELS = 4096 * 4096
"""At which a network may be asked to work; it takes some 0.6 kB of memory for each."""


def open_all(paths: Sequence[Path]) -> PairDataset:
    """Several folders of pairs as one data set.

    Raises:
        InputError: One of them cannot be opened.
    """
    return join([open_pairs(path) for path in paths])


def parse_size(text: str | None) -> tuple[int, int] | None:
    """ROWSxCOLUMNS as numbers.

    Raises:
        InputError: The text is something else, or a size beyond `MAXIMUM_PIXELS`.
    """
    if text is None:
        return None
    rows, _, columns = text.lower().partition("x")
    if not (rows.isdigit() and columns.isdigit()):
        raise InputError(f"--size {text}: ROWSxCOLUMNS is needed, for instance --size 512x640")
    if int(rows) * int(columns) > MAXIMUM_PIXELS:
        raise InputError(
            f"--size {text}: at most {MAXIMUM_PIXELS} px are allowed, such as 4096x4096, which takes 10 GB of memory"
        )
    return int(rows), int(columns)


def run_train(
    data: Sequence[Path],
    validation: Sequence[Path],
    out: Path,
    config: str | None,
    assignments: Sequence[str],
    options: dict[str, Any],
    resume: bool,
    weights: Path | None,
) -> int:
    """`train`, and `finetune` where weights are given."""
    from gelflow.train import train
    from gelflow.train.checkpoint import load_weights
    from gelflow.train.keeper import is_first_process

    start = {} if weights is None else {"model": load_weights(weights).config.model_dump()}
    settings = train_config(config, assignments, options, start)
    validation_set = open_all(validation) if validation else None
    result = train(settings, open_all(data), validation_set, out, initial=weights, resume=resume)
    if is_first_process():
        print(result)
    return 0


def run_evaluate(
    data: Sequence[Path],
    weights: Path | None,
    registration: Registration | None,
    size: str | None,
    device: str,
    as_json: bool,
) -> int:
    """`evaluate`."""
    network = open_network(weights_file(weights), None, parse_size(size), device, registration)
    _score(open_all(data), [network], None, as_json, 1)
    return 0


def run_compare(
    data: Sequence[Path],
    out: Path | None,
    methods: str,
    weights: Sequence[str],
    registrations: Sequence[Registration] | None,
    size: str | None,
    device: str,
    as_json: bool,
    fine_tuning: tuple[int, str | None],
    batch: int,
    every: int,
    add: bool,
) -> int:
    """`compare`; `methods` are separated by commas, `weights` are FILE or LABEL=FILE, of the pairs each `every`-th.

    `registrations` are for GelFlow's networks, a row of each; `fine_tuning` is the number of steps, 0 for none, and the
    configuration of a test-time optimisation.
    """
    if add and out is None:
        raise InputError("--add: give the folder of the earlier comparison as --out")
    for option, given, least in (("--every", every, 1), ("--batch", batch, 0), ("--ft", fine_tuning[0], 0)):
        if given < least:
            raise InputError(f"{option} {given}: a number from {least} on is needed")
    chosen = named_methods([name.strip() for name in methods.split(",") if name.strip()], device)
    networks = [network for given in weights for network in _labelled(given, registrations, size, device)]
    steps, config = fine_tuning
    own = [network for network in networks if isinstance(network, Learned)]
    if registrations and not own:
        raise InputError(
            "--registration: needs --weights of GelFlow; of DIS there are dis-motion, dis-both, dis-brightness"
        )
    dataset = open_all(data)
    dataset = PairDataset(dataset.source, dataset.records[::every])
    if steps > 0:
        if out is None or not own:
            raise InputError(f"--ft {steps}: needs --weights of GelFlow, and --out beside which their copies are kept")
        folder = out.with_name(f"{out.name}_ft")
        networks += [fine_tuned(one, dataset, folder / one.label.replace("/", "_"), steps, config) for one in own]
    _score(dataset, [*chosen, *networks], out, as_json, batch, add)
    return 0


def _labelled(
    given: str, registrations: Sequence[Registration] | None, size: str | None, device: str
) -> list[Learned | PublishedRaft]:
    """The rows of one --weights: of GelFlow one for each --registration, of RAFT, which it does not concern, one."""
    from gelflow.models.raft import looks_like_raft

    label, equals, file = given.partition("=")
    path, name = weights_file(Path(file if equals else given)), label if equals else None
    choices = (None,) if not registrations or looks_like_raft(path) else tuple(registrations)
    return [open_network(path, name, parse_size(size), device, choice) for choice in choices]


def _score(
    dataset: PairDataset, methods: Sequence[Method], out: Path | None, as_json: bool, batch: int, add: bool = False
) -> Comparison:
    done = 0
    with progress("pairs", not as_json) as advance:

        def step(score: PairScore) -> None:
            nonlocal done
            done += 1
            advance(done, len(dataset) * len(methods), f"{score.method}, {score.pair}")

        result = compare(methods, dataset, out, step, batch, add)
    if as_json:
        print(result.to_json())
        return result
    print(f"{', '.join(result.data)}; times on {devices(result)}")
    for title, table in tables(result):
        show_table(title, *table)
    if out is not None:
        print(f"written: {', '.join(str(out / name) for name in FILES if (out / name).is_file())}")
    return result


def run_predict(
    inputs: Sequence[Path],
    out: Path,
    weights: Path | None,
    method: str | None,
    registration: Registration | None,
    reference: Reference,
    every: int,
    size: str | None,
    device: str,
    as_json: bool,
) -> int:
    """`predict`."""
    if len(inputs) not in (1, 2):
        raise InputError(f"{len(inputs)} inputs given; allowed: two images, or one video or folder of frames")
    for path in inputs:
        if not path.exists():
            raise InputError(f"{path}: there is no such file or folder")
    if method is not None and weights is None:
        if registration is not None:
            raise InputError(
                "--registration: is for --weights of GelFlow; "
                "of DIS there are --method dis-motion, dis-both, dis-brightness"
            )
        estimator = named_methods([method], device)[0]
    elif method is None:
        estimator = open_network(weights_file(weights), None, parse_size(size), device, registration)
    else:
        raise InputError("give either --weights FILE (of a network) or --method NAME (a classical one)")
    if len(inputs) == 2:
        result = predict_pair(estimator, inputs[0], inputs[1], out)
    else:
        with progress("frames, then overlay", not as_json) as advance:
            result = predict_video(estimator, inputs[0], out, reference, every, lambda n, total: advance(n, total, ""))
    _show_prediction(result, estimator.name, as_json)
    return 0


def _show_prediction(result: Prediction, name: str, as_json: bool) -> None:
    if as_json:
        motions = [asdict(motion) for motion in result.motions]
        print(json.dumps({"files": [str(file) for file in result.files], "motions": motions}))
        return
    largest = max(result.motions, key=lambda motion: motion.p95_px)
    where = f" in frame {largest.frame}, the one with most motion," if len(result.motions) > 1 else ""
    print(f"{name}:{where} mean motion {largest.mean_px:.3g} px, 95th percentile {largest.p95_px:.3g} px")
    shown = result.files if len(result.files) <= 6 else [result.files[0], "...", *result.files[-3:]]
    print(f"written: {', '.join(str(file) for file in shown)}")


def run_export(weights: Path, out: Path, size: str | None) -> int:
    """`export`."""
    rows, columns = export_onnx(weights_file(weights), out, parse_size(size))
    print(f"written: {out} (image1, image2: 1x3x{rows}x{columns} in [0, 1]; flow: 1x2x{rows}x{columns} in px)")
    return 0


def run_pairs(inputs: Sequence[str], out: Path, config: ChoiceConfig, as_json: bool) -> int:
    """`pairs`."""
    total = len(find_recordings(inputs))
    with progress("recordings", not as_json) as advance:

        def step(done: int, _: int, name: str, outcome: SourceReport | str) -> None:
            if isinstance(outcome, str):
                print(f"gelflow: skipped: {outcome}", file=sys.stderr)
            advance(done, total, name)

        result = extract_pairs(inputs, out, config, step)
    if not result.sources:
        raise InputError(f"none of the {len(result.failures)} recordings can be read; the reasons are in {out / FILE}")
    if not result.pairs:
        raise InputError(
            f"no pair of the {len(result.sources)} recordings has a motion of {config.minimum_motion_px:g} to "
            f"{config.maximum_motion_px:g} px; give a lower --min-motion and another --out"
        )
    _show_pairs(result, out, as_json)
    return 1 if result.failures else 0


def _show_pairs(result: PairSet, out: Path, as_json: bool) -> None:
    motions = sorted(pair.motion_px for pair in result.pairs)
    deciles = quantiles(motions, n=10, method="inclusive") if len(motions) > 1 else motions
    deciles = [round(value, 1) for value in deciles]
    empty = sum(report.chosen == 0 for report in result.sources.values())
    if as_json:
        answer = {
            "out": str(out),
            "pairs": len(motions),
            "recordings": len(result.sources),
            "without_pairs": empty,
            "failures": result.failures,
            "motion_deciles_px": deciles,
        }
        print(json.dumps(answer))
        return
    counts = f"{empty} without enough motion, {len(result.failures)} unreadable"
    print(f"{len(motions)} pairs from {len(result.sources)} recordings ({counts}) in {out}")
    print(f"motion (95th percentile over the image, px): {motions[0]:.1f} to {motions[-1]:.1f}, deciles {deciles}")
