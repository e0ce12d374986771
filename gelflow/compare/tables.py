"""The tables of a comparison.

Methods that were optimised on the very pairs come last and, in the table of means, apart. Trainings that
differ in their seed alone are one row (see `gelflow.compare.seeds`): mean ± standard deviation, pooled pixels in
the strata.
"""

from collections.abc import Mapping, Sequence
from statistics import fmean

from gelflow.compare.comparison import Comparison
from gelflow.compare.scores import MethodScore, PairScore, summarise
from gelflow.compare.seeds import Group, grouped
from gelflow.compare.speed import Speed
from gelflow.compare.strata import Stratum, pooled
from gelflow.methods.name import MethodName

MOST_PAIRS_IN_A_TABLE = 12
"""Above this many pairs, tables show means only; CSV and JSON always have every pair."""

Table = tuple[list[str], list[list[str]]]
"""Header and rows, as text."""

NONE = "-"

EXPLAINED = {
    "EPE px": "EPE px, median px: mean and median endpoint error",
    "dots px": "dots px, 90 % px: median and 90th percentile distance of dots of image 1, moved by the flow, from the "
    "nearest dots of image 2",
    "own dot %": "own dot %: share of these dots that reach a dot of their own, within a quarter of the pitch and "
    "nearer to it than any other (as they also do if the flow is wrong by a whole pitch)",
    "closure px": "closure px, 90 % px: median and 90th percentile of the motion left after going there and back",
    "unknown %": "unknown %: share of pixels whose σ is too large for use",
    "error ≤ σ %": "error ≤ σ %: share of pixels with σ ≤ 0.1 px that err by at most σ; 68 if σ is calibrated",
    "ms/pair": "ms/pair, core ms: median run time after a warm-up, and processor time of all threads",
}
"""What columns of the table of means say, by their heading, or by the first of two."""


def number(value: float | None, digits: int, spread: float | None = None) -> str:
    """A number for a table, with its standard deviation if there is one; a dash where there is none."""
    if value is None:
        return NONE
    return f"{value:.{digits}f}" + ("" if spread is None else f" ± {spread:.{digits}f}")


def summary_table(groups: Sequence[Group]) -> Table:
    """Means over the pairs, a row per method; columns that no method has are left out.

    The distance to tracked dots is not averaged here: tracks differ too much in how far they can be trusted. Where all
    ran on one device its column is left out, too.
    """
    columns = [
        ("PSNR dB", "psnr_db", 1, 2),
        ("SSIM", "ssim", 1, 4),
        ("EPE px", "endpoint_error_px", 1, 3),
        ("median px", "median_error_px", 1, 3),
        ("> 1 px %", "outliers_1px", 100, 1),
        ("> 0.1 px %", "outliers_01px", 100, 1),
        ("dots px", "dot_distance_px", 1, 3),
        ("90 % px", "dot_p90_px", 1, 3),
        ("own dot %", "own_dots", 100, 1),
        ("closure px", "closure_px", 1, 3),
        ("90 % px", "closure_p90_px", 1, 3),
        ("unknown %", "unknown", 100, 1),
        ("σ ≤ 0.1 px %", "certain", 100, 1),
        ("error ≤ σ %", "calibration", 100, 1),
        ("ms/pair", "seconds", 1000, 1),
        ("core ms", "processor_seconds", 1000, 1),
    ]
    header = ["method", *(column[0] for column in columns), "on"]
    rows = [[group.label, *(_scaled(group, *column[1:]) for column in columns), group.device] for group in groups]
    kept = [k for k in range(len(header)) if any(row[k] != NONE for row in rows)]
    if len({row[-1] for row in rows}) < 2:
        kept = [k for k in kept if k < len(header) - 1]
    return [header[k] for k in kept], [[row[k] for k in kept] for row in rows]


def _scaled(group: Group, field: str, factor: float, digits: int) -> str:
    value, spread = group.mean(field), group.spread(field)
    return number(None if value is None else factor * value, digits, None if spread is None else factor * spread)


def pair_table(scores: Sequence[PairScore], fields: Sequence[str], form: str) -> Table:
    """A row per method and a column per pair, as in the paper; the mean over seeds.

    `fields` of a score make a cell, `form` is how to write them, "{:.2f} / {:.3f}". Pairs for which no method has all
    of them are left out.
    """
    found: dict[tuple[MethodName, str], list[list[float]]] = {}
    for score in scores:
        values = [getattr(score, field) for field in fields]
        if None not in values:
            found.setdefault((score.method.group, score.pair), []).append(values)
    pairs = [pair for pair in dict.fromkeys(s.pair for s in scores) if any(pair == known for _, known in found)]
    rows = []
    for group in _ordered(summarise(scores)):
        cells = [found.get((group.name, pair)) for pair in pairs]
        rows.append([group.label, *(form.format(*map(fmean, zip(*c, strict=True))) if c else NONE for c in cells)])
    return ["method", *pairs], rows if pairs else []


def strata_table(strata: Mapping[MethodName, Sequence[Stratum]]) -> Table:
    """Mean endpoint error in px, a row per bin, a column per method; every pixel of a bin counts the same."""
    by_method = pooled(strata)
    cells = {(name, s.kind, s.bin): s.error_px / s.pixels for name, bins in by_method.items() for s in bins}
    sizes = {(s.kind, s.bin): s.pixels for s in next(iter(strata.values()), [])}
    rows = [
        [f"{kind}: {part}", str(pixels), *(number(cells.get((name, kind, part)), 3) for name in by_method)]
        for (kind, part), pixels in sizes.items()
    ]
    return ["where", "pixels", *map(str, by_method)], rows


def speed_table(speeds: Mapping[MethodName, Speed]) -> Table:
    """A row for the speed and memory of each network."""
    header = ["network", "device", "pairs at once", "size", "pairs/s", "peak memory MiB"]
    rows = [
        [name, s.device, str(s.batch), f"{s.size[0]}x{s.size[1]}", f"{s.pairs_per_second:.2f}", number(s.memory_mib, 0)]
        for name, s in zip(map(str, speeds), speeds.values(), strict=True)
    ]
    return header, rows


def tables(comparison: Comparison) -> list[tuple[str, Table]]:
    """The tables of a comparison with their titles, as they are printed."""
    groups = _ordered(summarise(comparison.scores))
    pairs = len(comparison.pairs)
    compared = summary_table([group for group in groups if not group.name.fine_tuned])
    explained = [EXPLAINED[name] for name in compared[0] if name in EXPLAINED]
    means = ".\n".join([f"Means over {pairs} pairs", *explained]) + "."
    patterned, some = with_pattern(comparison)
    without = f"Means over the {some} pairs of gels with a pattern."
    apart = "Fine-tuned on these very pairs (test-time optimisation, not comparable with the rest)."
    found = [
        (means, compared),
        (without, summary_table(patterned) if some < pairs else ([], [])),
        (apart, summary_table([group for group in groups if group.name.fine_tuned])),
    ]
    if pairs <= MOST_PAIRS_IN_A_TABLE:
        each = [
            ("PSNR dB / SSIM", "{:.2f} / {:.3f}", ("psnr_db", "ssim")),
            ("mean endpoint error in px", "{:.3f}", ("endpoint_error_px",)),
            ("median distance to tracked dots in px", "{:.2f}", ("marker_distance_px",)),
            ("distance from dots, median / 90th percentile in px / share that reach a dot of their own",
             "{:.3f} / {:.3f} / {:.0%}", ("dot_distance_px", "dot_p90_px", "own_dots")),
            ("closure, median / 90th percentile in px", "{:.3f} / {:.3f}", ("closure_px", "closure_p90_px")),
        ]  # fmt: skip
        found += [(f"Each pair: {name}.", pair_table(comparison.scores, fields, form)) for name, form, fields in each]
    title = "Mean endpoint error in px by the true motion, place, pattern and scene, over all pixels of a bin."
    found.append((title, strata_table(comparison.strata)))
    found.append(("Networks alone, forward pass.", speed_table(comparison.speeds)))
    return [(title, table) for title, table in found if table[1]]


def with_pattern(comparison: Comparison) -> tuple[list[Group], int]:
    """Means over the pairs of gels with a pattern, and their number; over all pairs if no gel has one."""
    scores = [score for score in comparison.scores if score.scene is None or not score.scene.bare]
    scores = scores or list(comparison.scores)
    return _ordered(summarise(scores)), len({score.pair for score in scores})


def _ordered(means: Sequence[MethodScore]) -> list[Group]:
    """Groups, those that were optimised on the pairs last."""
    return sorted(grouped(means), key=lambda group: group.name.fine_tuned)
