"""Real processes: two workers, kill -9, Ctrl-C. Whatever happens, the same command ends with the same files."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from tiny_scene import fingerprint, own_cache, reference, write_tiny

from synth.cli import main
from synth.generate import generate
from synth.template import load_scene

ROOT = Path(__file__).parents[2]
PATIENCE_S = 120.0


@pytest.fixture(autouse=True)
def _cache(monkeypatch: pytest.MonkeyPatch) -> None:
    """One mesh for all runs: the mesher is random."""
    own_cache(monkeypatch)


def _start(scene: Path, out: Path, *options: str) -> "subprocess.Popen[str]":
    """The command in a session of its own, as from a terminal."""
    command = [sys.executable, "-m", "synth", "generate", "--scene", str(scene), "--out", str(out), *options]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=ROOT, stdout=pipe, stderr=pipe, text=True, start_new_session=True)


def _lines(out: Path) -> int:
    manifest = out / "manifest.jsonl"
    return manifest.read_bytes().count(b"\n") if manifest.exists() else 0


def _wait_for(what: str, holds: Callable[[], bool], process: "subprocess.Popen[str] | None" = None) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < deadline, f"waited {PATIENCE_S} s for {what}"
        if process is not None and process.poll() is not None:
            raise AssertionError(f"ended with {process.returncode} before {what}: {process.communicate()[1]}")
        time.sleep(0.005)


def _alive(pids: Sequence[int]) -> list[int]:
    """Those that run; a process that has ended and that nobody has asked about yet is none."""

    def runs(pid: int) -> bool:
        try:
            return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
        except OSError:
            return False

    return [pid for pid in pids if runs(pid)]


def _descendants(pid: int) -> list[int]:
    children = [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return children + [below for child in children for below in _descendants(child)]


def _own_words(stderr: str) -> list[str]:
    """What synth said; Warp remarks on a missing GPU by itself, and Python's semaphores on a killed parent."""
    return [line for line in stderr.splitlines() if line.startswith("synth:") or "Traceback" in line or "Error" in line]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds child processes in Linux's /proc")
def test_killed_with_two_workers_and_started_again(tmp_path: Path) -> None:
    scene, out = write_tiny(tmp_path), tmp_path / "d"
    process = _start(scene, out, "--n", "5", "--workers", "2")
    _wait_for("the first sample", lambda: _lines(out) > 0, process)
    family = _descendants(process.pid)
    assert len(family) >= 2
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert 0 < _lines(out) < 5
    _wait_for("the workers to leave with their driver", lambda: not _alive(family))
    again = _start(scene, out, "--n", "5", "--workers", "2")
    stdout, stderr = again.communicate(timeout=PATIENCE_S)
    assert again.returncode == 0, stderr
    assert "were there" in stdout
    assert fingerprint(out) == fingerprint(reference())


def _assert_goes_on(scene: Path, out: Path) -> None:
    """After an interruption the job's first five samples come out as ever, and nothing torn is left."""
    generate(load_scene(scene), 5, out)
    assert not list((out / "samples").glob(".*"))
    found, expected = fingerprint(out), fingerprint(reference())
    same = [name for name in expected if name not in ("dataset.json", "manifest.jsonl")]  # these tell of 400 samples
    assert {name: found[name] for name in same} == {name: expected[name] for name in same}
    assert found["manifest.jsonl"][:5] == expected["manifest.jsonl"]


INTERRUPTED = "synth: interrupted; finished samples are kept: run the same command again to go on"


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds child processes in Linux's /proc")
def test_ctrl_c_with_workers_ends_with_130_one_line_and_no_orphans(tmp_path: Path) -> None:
    scene, out = write_tiny(tmp_path), tmp_path / "d"
    process = _start(scene, out, "--n", "400", "--workers", "2")
    _wait_for("the first sample", lambda: _lines(out) > 0, process)
    family = _descendants(process.pid)
    assert len(family) >= 2
    os.killpg(process.pid, signal.SIGINT)  # a terminal sends it to the whole group
    _, stderr = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, stderr
    assert _own_words(stderr) == [INTERRUPTED]
    _wait_for("the workers to leave", lambda: not _alive(family))
    assert _lines(out) < 400
    _assert_goes_on(scene, out)


def test_ctrl_c_in_one_process_ends_with_130_and_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, out = write_tiny(tmp_path), tmp_path / "d"

    def press_ctrl_c() -> None:
        _wait_for("the first sample", lambda: _lines(out) > 0)
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # whatever other tests left: pytest must survive
    thread = threading.Thread(target=press_ctrl_c)
    thread.start()
    try:
        status = main(["generate", "--scene", str(scene), "--out", str(out), "--n", "400"])
    finally:
        thread.join()
        signal.signal(signal.SIGINT, before)
    assert status == 130
    assert _own_words(capsys.readouterr().err) == [INTERRUPTED]
    assert _lines(out) < 400
    _assert_goes_on(scene, out)


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds child processes in Linux's /proc")
def test_a_worker_that_dies_is_said_in_one_line(tmp_path: Path) -> None:
    scene, out = write_tiny(tmp_path), tmp_path / "d"
    process = _start(scene, out, "--n", "400", "--workers", "2")
    _wait_for("the first sample", lambda: _lines(out) > 0, process)
    family = _descendants(process.pid)
    workers = [pid for pid in family if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    assert len(workers) == 2
    os.kill(workers[0], signal.SIGKILL)
    _, stderr = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2, stderr
    (words,) = _own_words(stderr)
    assert words.startswith("synth: a worker process died")
    _wait_for("the other worker to leave", lambda: not _alive(family))


AFTER_MESHING = """
import os, signal, time
from synth.mesh.tetrahedralise import tetrahedralise_box
tetrahedralise_box((4.0, 4.0, 2.0), 2.0)
try:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(10)
except KeyboardInterrupt:
    print("interrupted")
"""


def test_ctrl_c_still_reaches_python_after_meshing() -> None:
    """FTetWild's library takes the signal for itself; then the process would end without a word and without order."""
    done = subprocess.run([sys.executable, "-c", AFTER_MESHING], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("interrupted\n")
