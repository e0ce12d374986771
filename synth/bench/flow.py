"""`synth bench flow`: how exact the ground-truth flow is, and what simpler generators of it would give."""

import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path

SCENES = ("gelsight_mini", "tac3d", "densetact")
"""A flat pad seen straight, one seen by mirrors, which hide some of it, and a dome seen by a fisheye lens."""


def run_flow(scenes: Sequence[str], out: Path, seed: int, as_json: bool) -> int:
    """Measure and write OUT/flow.csv, flow.png and flow.md.

    Args:
        scenes: names or files; none: SCENES.
        out: directory.
        seed: of the draws.
        as_json: print the rows instead of the summary.

    Returns:
        0, or 1 when `synth verify` would object to the shipped flow.

    Raises:
        InputError: a scene that cannot be pressed, or two of one name; storage that refuses.
    """
    from synth.bench.flow_measure import failures, measure, truth
    from synth.bench.flow_picture import plot
    from synth.bench.flow_report import Results, report, summary, table
    from synth.bench.render_subject import press
    from synth.dataset.jsontext import to_line
    from synth.dataset.storage import replace_file, report_folder
    from synth.errors import InputError
    from synth.scene.template import load_scene

    began = time.perf_counter()
    report_folder(out, "flow")
    scenes = scenes or SCENES
    templates = [load_scene(scene) for scene in scenes]
    names = [template.name for template in templates]
    if len(set(names)) < len(names):
        raise InputError(f"the scenes' names are {', '.join(names)}; each may be given once")
    results = Results()
    for name, template in zip(names, templates, strict=True):
        _say(f"{name}: pressing")
        subject = press(template, seed, None)
        _say(f"{name}: deriving the flow by other code")
        pair = truth(subject.own)
        results.rows += measure(name, subject.own, pair, _say)
        results.failures += [f"{name}: {line}" for line in failures(subject.own, pair)]
        results.subjects[name], results.pairs[name] = subject, pair
    results.seconds = time.perf_counter() - began
    command = f"python -m synth bench flow {' '.join(shlex.quote(Path(s).name) for s in scenes)} --out DIR"
    command += f" --seed {seed}" * (seed != 0)
    replace_file(out / "flow.csv", table(results))
    replace_file(out / "flow.png", plot(results.rows))
    replace_file(out / "flow.md", report(results, command).encode("utf-8"))
    if as_json:
        print(to_line({"rows": results.record(), "failures": results.failures}), end="")
    else:
        print("\n".join([*summary(results), f"written: {out / 'flow.md'}"]))
    return 1 if results.failures else 0


def _say(line: str) -> None:
    print(f"synth: {line}", file=sys.stderr, flush=True)
