"""`synth bench`: what the command does."""

import json
import sys
from pathlib import Path

from synth.errors import InputError

BENCHES = ("fem",)


def run_bench(what: str, out: Path, quick: bool, as_json: bool, processes: int = 2) -> int:
    """Measure error against run time and write OUT/fem.csv, fem.png and fem.md.

    Args:
        what: "fem".
        out: directory.
        quick: a handful of settings of the first case, in about two minutes.
        as_json: print the rows instead of the summary.
        processes: how many presses run at once.

    Returns:
        0, or 1 when a setting of the standard family did not reach the end of its press.

    Raises:
        InputError: an unknown benchmark; the storage refuses.
    """
    if what not in BENCHES:
        raise InputError(f"there is no benchmark {what!r}; allowed are: {', '.join(BENCHES)}")
    from synth.bench import suite
    from synth.bench.fem import measure
    from synth.bench.report import record, summary, write_results
    from synth.dataset.storage import report_folder
    from synth.scene.template import load_scene
    from synth.simulate.resolution import scale_px_per_mm

    report_folder(out, "fem")
    scale = scale_px_per_mm(load_scene("gelsight_mini", []).corners[0])
    results = measure(
        suite.quick() if quick else suite.whole(),
        scale,
        processes,
        say=lambda line: print(f"synth: {line}", file=sys.stderr, flush=True),
    )
    write_results(out, results, "python -m synth bench fem" + (" --quick" if quick else ""))
    print(json.dumps(record(results)) if as_json else "\n".join([*summary(results), f"written: {out / 'fem.md'}"]))
    standard = [row for row in results.rows if row.setting.family == "graded P2/P1"]
    return 0 if all(row.complete for row in standard) else 1
