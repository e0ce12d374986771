"""Real processes: workers, kill -9, Ctrl-C. Whatever happens, the same command ends with the same files."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from processes_of import HAS_PROC, PATIENCE_S, ROOT, alive, descendants, lines, own_words, start, wait_for, workers_of
from tiny_scene import fingerprint, reference, write_tiny

from synth.cli import main
from synth.pipeline.generate import generate
from synth.scene.template import load_scene

needs_proc = pytest.mark.skipif(not HAS_PROC, reason="finds child processes in Linux's /proc")


pytestmark = pytest.mark.usefixtures("one_cache")


@pytest.fixture(autouse=True)
def _ctrl_c() -> None:
    """A shell starts background jobs with Ctrl-C ignored, and the processes that tests start would inherit it."""
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@needs_proc
def test_killed_with_two_workers_and_started_again(tmp_path: Path) -> None:
    scene, out = write_tiny(tmp_path), tmp_path / "d"
    process = start(scene, out, "--n", "5", "--workers", "2")
    wait_for("the first sample", lambda: lines(out) > 0, process)
    family = descendants(process.pid)
    assert len(family) >= 2
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert 0 < lines(out) < 5
    wait_for("the workers to leave with their driver", lambda: not alive(family))
    again = start(scene, out, "--n", "5", "--workers", "2")
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


@needs_proc
def test_ctrl_c_with_workers_ends_with_130_one_line_and_no_orphans(tmp_path: Path) -> None:
    scene, out = write_tiny(tmp_path), tmp_path / "d"
    process = start(scene, out, "--n", "400", "--workers", "2")
    wait_for("the first sample", lambda: lines(out) > 0, process)
    family = descendants(process.pid)
    assert len(family) >= 2
    os.killpg(process.pid, signal.SIGINT)  # a terminal sends it to the whole group
    _, stderr = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, stderr
    assert own_words(stderr) == [INTERRUPTED]
    wait_for("the workers to leave", lambda: not alive(family))
    assert lines(out) < 400
    _assert_goes_on(scene, out)


def test_ctrl_c_in_one_process_ends_with_130_and_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, out = write_tiny(tmp_path), tmp_path / "d"

    def press_ctrl_c() -> None:
        wait_for("the first sample", lambda: lines(out) > 0)
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
    assert own_words(capsys.readouterr().err) == [INTERRUPTED]
    assert lines(out) < 400
    _assert_goes_on(scene, out)


@needs_proc
def test_a_killed_worker_is_replaced(tmp_path: Path) -> None:
    """One of two, in mid-task; the run goes on and ends with the files of an undisturbed one."""
    scene, out = write_tiny(tmp_path), tmp_path / "d"
    process = start(scene, out, "--n", "5", "--workers", "2")
    wait_for("the first sample", lambda: lines(out) > 0, process)
    os.kill(workers_of(process.pid)[0], signal.SIGKILL)
    _, stderr = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, stderr
    (words,) = own_words(stderr)
    assert words.startswith("synth: a worker process died; trajectories ")
    assert fingerprint(out) == fingerprint(reference())


@needs_proc
def test_workers_that_die_again_and_again_are_said_in_one_line(tmp_path: Path) -> None:
    """Each pool loses its workers as soon as they are there: the third is the last."""
    scene, out = write_tiny(tmp_path), tmp_path / "d"
    process = start(scene, out, "--n", "400", "--workers", "2")
    while process.poll() is None:
        for pid in workers_of(process.pid):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(0.02)
    _, stderr = process.communicate()
    assert process.returncode == 2, stderr
    *notes, words = own_words(stderr)
    assert len(notes) == 2
    assert words.startswith("synth: worker processes died 3 times in a row")
    assert lines(out) == 0
    assert list((out / "samples").iterdir()) == []


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
