"""Comparing methods on the same pairs."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from gelflow.baselines.learned import Learned, PublishedRaft
from gelflow.baselines.method import Method
from gelflow.data.pairs import PairDataset
from gelflow.errors import InputError
from gelflow.evaluate import PairScore, evaluate
from gelflow.report import write_report
from gelflow.speed import Speed, network_speed


class Comparison(NamedTuple):
    """Scores of every method on every pair, method after method, and the speed of the networks by name."""

    scores: list[PairScore]
    speeds: dict[str, Speed]


def compare(
    methods: Sequence[Method],
    dataset: PairDataset,
    out: Path | None = None,
    progress: Callable[[PairScore], None] | None = None,
    batch: int = 1,
) -> Comparison:
    """Scores every method on every pair, method after method.

    Args:
        methods: At least one, with names that differ.
        dataset: The pairs.
        out: Folder for the files of `gelflow.report.FILES`; written anew after each method, so that an interruption
            loses one method at most. An earlier comparison on the same data is replaced.
        progress: Called after each pair.
        batch: Pairs at once where the speed of networks is measured; 0: it is not.

    Raises:
        InputError: No method, two of one name, `out` holds other things, or a pair cannot be read.
        OSError: A file cannot be written.
    """
    names = [method.name for method in methods]
    if not names:
        raise InputError("no method given; there is nothing to compare")
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two methods are called {name!r}; give one a label of its own: --weights LABEL=FILE")
    if out is not None:
        _check_out(out, dataset.source)
    scores: list[PairScore] = []
    speeds: dict[str, Speed] = {}
    for method in methods:
        scores += evaluate(method, dataset, progress)
        if batch > 0 and isinstance(method, Learned | PublishedRaft):
            shape = dataset.images(0)[0].shape
            size = method.size or getattr(method.model, "image_size", None) or (shape[0], shape[1])
            speeds[method.name] = network_speed(method.model, size, batch, method.device)
        if out is not None:
            write_report(out, [dataset.source], scores, speeds)
    return Comparison(scores, speeds)


def _check_out(out: Path, source: str) -> None:
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    path = out / "scores.json"
    if not path.is_file():
        raise InputError(f"{out}: exists and holds other things; give an empty or a new folder as --out")
    try:
        before = json.loads(path.read_text(encoding="utf-8"))["data"]
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not the scores of a comparison; give another --out") from error
    if before != [source]:
        raise InputError(f"{out}: holds a comparison on {', '.join(map(str, before))}, not on {source}; "
                         "give another --out")  # fmt: skip
