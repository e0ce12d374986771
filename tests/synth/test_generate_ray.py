"""Real Ray: a local cluster of two worker processes, one of which is killed in mid-task."""

import os
import signal
from pathlib import Path

import pytest
from processes_of import HAS_PROC, PATIENCE_S, lines, start, wait_for, workers_of
from tiny_scene import fingerprint, reference, write_tiny

from synth.errors import InputError
from synth.pipeline.generate import Scheduling, generate
from synth.scene.template import load_scene

pytest.importorskip("ray", reason="Ray is not installed: pip install -e '.[cluster]'")


pytestmark = pytest.mark.usefixtures("one_cache")


@pytest.mark.slow
@pytest.mark.skipif(not HAS_PROC, reason="finds child processes in Linux's /proc")
def test_a_worker_killed_in_mid_task_changes_nothing(tmp_path: Path) -> None:
    scene, out = write_tiny(tmp_path), tmp_path / "d"
    process = start(scene, out, "--n", "5", "--ray", "local", "--workers", "2")
    busy = b"ray::_work"  # an idle worker is called ray::IDLE
    wait_for("a worker at its task", lambda: bool(workers_of(process.pid, busy)), process)
    killed = workers_of(process.pid, busy)[0]
    os.kill(killed, signal.SIGKILL)
    wait_for("another worker", lambda: bool(set(workers_of(process.pid, busy)) - {killed}), process)
    _, stderr = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, stderr
    assert lines(out) == 5
    assert fingerprint(out) == fingerprint(reference())


def test_no_such_cluster_is_said_at_once(tmp_path: Path) -> None:
    template = load_scene(write_tiny(tmp_path))
    with pytest.raises(InputError, match=r"--ray 127\.0\.0\.1:9: there is no cluster"):
        generate(template, 1, tmp_path / "d", scheduling=Scheduling(ray="127.0.0.1:9"))
