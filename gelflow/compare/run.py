"""Comparing methods on the same pairs."""

from collections.abc import Callable, Sequence
from pathlib import Path

from gelflow.baselines.learned import Learned, PublishedRaft
from gelflow.baselines.method import Method
from gelflow.compare.comparison import Comparison, read_comparison
from gelflow.compare.report import SCORES, write_report
from gelflow.compare.scores import PairScore, evaluate
from gelflow.compare.speed import Speed, network_speed
from gelflow.data.pairs import PairDataset
from gelflow.errors import InputError

SAME_MOTION_PX = 0.01
"""Pairs of one name are the same pair if their true motions differ by no more than this in the mean."""


def compare(
    methods: Sequence[Method],
    dataset: PairDataset,
    out: Path | None = None,
    progress: Callable[[PairScore], None] | None = None,
    batch: int = 1,
    add: bool = False,
) -> Comparison:
    """Scores every method on every pair, method after method.

    Args:
        methods: At least one, with names that differ.
        dataset: The pairs.
        out: Folder for the report, written anew after each method, so that an interruption loses one method at most.
        progress: Called after each pair.
        batch: Pairs at once where the speed of networks is measured; 0: it is not.
        add: Keep the methods that `out` holds already, except those that are scored again. Without it an earlier
            comparison on the same data is replaced.

    Raises:
        InputError: No method, two of one name, `out` holds other things or a comparison of other pairs, or a pair
            cannot be read.
        OSError: A file cannot be written.
    """
    names = [method.name for method in methods]
    if not names:
        raise InputError("no method given; there is nothing to compare")
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two methods are called {name!r}; give one a label of its own: --weights LABEL=FILE")
    result = Comparison((dataset.source,), (), {}, {})
    if out is not None:
        earlier = _earlier(out, dataset, add)
        if add and earlier is not None:
            data = tuple(dict.fromkeys((*earlier.data, dataset.source)))
            kept = earlier.without(names)
            result = Comparison(data, kept.scores, kept.strata, kept.speeds)
    for method in methods:
        scores = evaluate(method, dataset, progress)
        _check_pairs(out, result, scores)
        result = result.with_method(scores, _speed(method, dataset, batch))
        if out is not None:
            write_report(out, result)
    return result


def _speed(method: Method, dataset: PairDataset, batch: int) -> Speed | None:
    if batch == 0 or not isinstance(method, Learned | PublishedRaft):
        return None
    shape = dataset.images(0)[0].shape
    size = method.size or getattr(method.model, "image_size", None) or (shape[0], shape[1])
    return network_speed(method.forward, size, batch, method.device)


def _earlier(out: Path, dataset: PairDataset, add: bool) -> Comparison | None:
    """What a folder holds already; InputError for something else, or a comparison of other pairs."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return None
    if not (out / SCORES).is_file():
        raise InputError(f"{out}: exists and holds other things; give an empty or a new folder as --out")
    earlier = read_comparison(out / SCORES)
    if earlier.pairs != dataset.names or not (add or dataset.source in earlier.data):
        raise InputError(f"{out}: holds a comparison on {', '.join(earlier.data)} ({len(earlier.pairs)} pairs), not on "
                         f"{dataset.source} ({len(dataset)} pairs); give another --out")  # fmt: skip
    return earlier


def _check_pairs(out: Path | None, earlier: Comparison, scores: Sequence[PairScore]) -> None:
    """Refuses to put scores beside those of other pairs of the same names."""
    known = {score.pair: score.motion_px for score in earlier.scores}
    for score in scores:
        before, now = known.get(score.pair, score.motion_px), score.motion_px
        if (before is None) != (now is None) or (before is not None and abs(before - (now or 0)) > SAME_MOTION_PX):
            raise InputError(f"{out}: there, pair {score.pair} has a mean true motion of {before} px, here {now} px; "
                             "these are other pairs; give another --out")  # fmt: skip
