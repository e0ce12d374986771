"""Workers that make whole trajectories: one core each, and the bits of a run without them."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from tiny_scene import fingerprint, job_context, reference, write_tiny

from synth.pipeline import worker_pool as pool
from synth.pipeline.generate import Scheduling, generate
from synth.pipeline.records import JobContext, Task
from synth.pipeline.threads import THREADS
from synth.pipeline.worker_pool import outcomes_of_processes
from synth.scene.template import load_scene

pytestmark = pytest.mark.usefixtures("one_cache")


@pytest.mark.parametrize("workers", [1, 2])
def test_workers_change_no_bit(tmp_path: Path, workers: int) -> None:
    """The reference was rendered in this process, on all cores."""
    out = tmp_path / "d"
    generate(load_scene(write_tiny(tmp_path)), 5, out, scheduling=Scheduling(workers))
    assert fingerprint(out) == fingerprint(reference())


def _threads(context: JobContext) -> Callable[[Task], tuple[int, ...]]:
    """In a worker that is ready for trajectories: its process, and the threads of renderer, OpenCV and the rest."""
    pool._trajectory_maker(context)
    import cv2
    import drjit

    return lambda _: (os.getpid(), drjit.thread_count(), cv2.getNumThreads(), *(int(os.environ[k]) for k in THREADS))


@pytest.mark.parametrize("workers", [1, 2])
def test_a_worker_is_a_process_that_takes_one_core(tmp_path: Path, monkeypatch, workers: int) -> None:
    for name in THREADS:
        monkeypatch.setenv(name, "2")
    monkeypatch.setattr(pool, "_trajectory_maker", _threads)
    context = job_context(load_scene(write_tiny(tmp_path)), 8, tmp_path / "d")
    found = list(outcomes_of_processes(context, ((k, (2 * k, 2 * k + 1)) for k in range(4)), workers))
    assert len(found) == 4
    assert os.getpid() not in {process for process, *_ in found}
    assert {tuple(threads) for _, *threads in found} == {(1,) * (2 + len(THREADS))}
    assert [os.environ[name] for name in THREADS] == ["2"] * len(THREADS)
