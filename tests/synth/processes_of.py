"""Watching and waiting for the command's processes, in tests that kill them; Linux's /proc."""

import contextlib
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PATIENCE_S = 120.0
HAS_PROC = Path("/proc/self/task").exists()
needs_proc = pytest.mark.skipif(not HAS_PROC, reason="finds child processes in Linux's /proc")


def start(scene: Path, out: Path | str, *options: str) -> "subprocess.Popen[str]":
    """The command `generate` in a session of its own, as from a terminal."""
    command = [sys.executable, "-m", "synth", "generate", "--scene", str(scene), "--out", str(out), *options]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=ROOT, stdout=pipe, stderr=pipe, text=True, start_new_session=True)


def started(scene: Path, out: Path, *options: str) -> "subprocess.Popen[str]":
    """The command, once its first sample is on record."""
    process = start(scene, out, *options)
    wait_for("the first sample", lambda: lines(out) > 0, process)
    return process


def end_family(process: "subprocess.Popen[str]", number: signal.Signals) -> str:
    """Kill or interrupt a command that has at least two workers, which must leave with it; what it said on stderr."""
    family = descendants(process.pid)
    assert len(family) >= 2
    if number == signal.SIGKILL:
        process.kill()
    else:
        os.killpg(process.pid, number)  # a terminal sends it to the whole group
    process.wait(PATIENCE_S)
    wait_for("the workers to leave with their driver", lambda: not alive(family))
    return process.communicate()[1]


def lines(out: Path) -> int:
    manifest = out / "manifest.jsonl"
    return manifest.read_bytes().count(b"\n") if manifest.exists() else 0


def wait_for(what: str, holds: Callable[[], bool], process: "subprocess.Popen[str] | None" = None) -> None:
    """Until something holds; fails after a while, or when the process ends before."""
    deadline = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < deadline, f"waited {PATIENCE_S} s for {what}"
        if process is not None and process.poll() is not None:
            raise AssertionError(f"ended with {process.returncode} before {what}: {process.communicate()[1]}")
        time.sleep(0.005)


def alive(pids: Sequence[int]) -> list[int]:
    """Those that run; a process that has ended and that nobody has asked about yet is none."""

    def runs(pid: int) -> bool:
        try:
            return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
        except OSError:
            return False

    return [pid for pid in pids if runs(pid)]


def descendants(pid: int) -> list[int]:
    try:
        children = [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []
    return children + [below for child in children for below in descendants(child)]


def workers_of(pid: int, name: bytes = b"spawn_main") -> list[int]:
    def command(pid: int) -> bytes:
        try:
            return Path(f"/proc/{pid}/cmdline").read_bytes()
        except OSError:
            return b""

    return [child for child in descendants(pid) if name in command(child)]


@contextlib.contextmanager
def largest_file(count: int) -> Iterator[None]:
    """Let no file become larger than so many bytes: a write beyond that fails as on a full disk, at the same place."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (count, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def own_words(stderr: str) -> list[str]:
    """What synth said; Warp remarks on a missing GPU by itself, and Python's semaphores on a killed parent."""
    return [line for line in stderr.splitlines() if line.startswith("synth:") or "Traceback" in line or "Error" in line]
