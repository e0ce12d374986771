"""`synth bench all`: every benchmark with its defaults, one after the other, each in a process of its own."""

import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Bench:
    """One of them.

    Attributes:
        name: of the command.
        minutes: that it took on two cores (its report in docs/reports).
        arguments: beside --out.
    """

    name: str
    minutes: float
    arguments: tuple[str, ...] = ()


BENCHES = (Bench("flow", 2), Bench("light", 2), Bench("scale", 5), Bench("render", 9))
"""The shortest first."""


def run_all(out: Path, as_json: bool) -> int:
    """Run each with OUT/<its name>; what one of them does wrong does not keep the others from running.

    Args:
        out: directory.
        as_json: print each one's status and seconds instead of their summaries, which go to stderr.

    Returns:
        0, or 1 when one of them did not end with 0.

    Raises:
        InputError: storage that refuses.
    """
    from synth.dataset.jsontext import to_line
    from synth.dataset.storage import storage_errors

    with storage_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    parts = ", ".join(f"{bench.name} {bench.minutes:g} min" for bench in BENCHES)
    _say(f"{parts}: {sum(bench.minutes for bench in BENCHES):g} min on two idle cores")
    answer = {}
    for number, bench in enumerate(BENCHES, 1):
        _say(f"bench {bench.name} ({number} of {len(BENCHES)})")
        began = time.perf_counter()
        status = _run(bench, out / bench.name, as_json)
        answer[bench.name] = {"status": status, "seconds": round(time.perf_counter() - began, 1)}
    if as_json:
        print(to_line(answer), end="")
    failed = [name for name, one in answer.items() if one["status"]]
    for name, one in answer.items():
        _say(f"bench {name}: {'status ' + str(one['status']) if name in failed else 'done'}, {one['seconds']:.0f} s")
    return 1 if failed else 0


def _run(bench: Bench, out: Path, as_json: bool) -> int:
    """Exit status of the command, in a fresh interpreter: no benchmark is timed in what another left behind."""
    command = [sys.executable, "-m", "synth", "bench", bench.name, *bench.arguments, "--out", str(out)]
    return subprocess.run(command, stdout=sys.stderr if as_json else None, check=False).returncode


def _say(line: str) -> None:
    print(f"synth: {line}", file=sys.stderr, flush=True)
