"""Worker processes and threads: one core each, the bits of a run without them."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from processes_of import HAS_PROC, workers_of
from tiny_scene import TEXT, fingerprint, job_context, reference, write_tiny

from synth.pipeline import worker_pool as pool
from synth.pipeline.generate import Scheduling, generate
from synth.pipeline.overlapped import outcomes_of_batches
from synth.pipeline.records import JobContext, Task
from synth.pipeline.worker_pool import THREADS, one_thread_each, outcomes_of_processes
from synth.scene.template import load_scene

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.usefixtures("one_cache")


@pytest.mark.processes
def test_a_worker_changes_no_bit(tmp_path: Path) -> None:
    """The reference was rendered in this process, on all cores."""
    out = tmp_path / "d"
    generate(load_scene(write_tiny(tmp_path)), 5, out, scheduling=Scheduling(workers=1))
    assert fingerprint(out) == fingerprint(reference())


@pytest.mark.processes
@pytest.mark.parametrize(("cores", "trajectories", "workers"), [(2, 3, 2), (3, 3, 3), (4, 3, None), (1, 3, None)])
def test_a_long_job_has_a_worker_for_each_core(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cores: int, trajectories: int, workers: int | None
) -> None:
    """Where each has something to do, and the memory for it."""
    module = sys.modules[generate.__module__]
    monkeypatch.setattr(module, "WORTH_A_WORKER", 1)
    monkeypatch.setattr(module, "cores", lambda: cores)
    template = load_scene(write_tiny(tmp_path))
    context = job_context(template, 5, tmp_path / "d")
    assert module._workers_here(context, trajectories) == workers
    if workers:
        generate(template, 5, tmp_path / "d")
        assert fingerprint(tmp_path / "d") == fingerprint(reference())
    monkeypatch.setattr(module, "predict", lambda plan: SimpleNamespace(memory_bytes=2**60))
    assert module._workers_here(context, trajectories) is None


UNGUARDED = """
import sys, synth
from synth.pipeline.generate import Scheduling
print("begins", flush=True)
print(synth.generate(sys.argv[1], n=2, out=sys.argv[2], scheduling=Scheduling(workers=2)).made)
"""


@pytest.mark.parametrize("piped", [True, False])
def test_a_script_needs_no_main_guard(tmp_path: Path, piped: bool) -> None:
    (tmp_path / "make.py").write_text(UNGUARDED)
    command = [sys.executable, "-" if piped else "make.py", str(write_tiny(tmp_path)), "out"]
    given, environment = UNGUARDED if piped else None, os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        command, cwd=tmp_path, input=given, env=environment, capture_output=True, text=True, check=False
    )
    assert (done.stdout, done.stderr) == ("begins\n2\n", "")


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


def test_a_pool_that_breaks_while_it_starts_a_worker(tmp_path: Path, monkeypatch, capsys) -> None:
    submit, errors = pool.ProcessPoolExecutor.submit, [OSError("handle is closed"), ValueError("bad value(s)")]

    def submit_late(executor: Any, function: Any, *args: Any) -> Any:
        if errors and function is pool._work:
            raise errors.pop()
        return submit(executor, function, *args)

    monkeypatch.setattr(pool.ProcessPoolExecutor, "submit", submit_late)
    monkeypatch.setattr(pool, "_trajectory_maker", _threads)
    context = job_context(load_scene(write_tiny(tmp_path)), 8, tmp_path / "d")
    assert len(list(outcomes_of_processes(context, ((k, (2 * k, 2 * k + 1)) for k in range(4)), 1))) == 4
    assert capsys.readouterr().err == "synth: a worker process died; trajectories 0 are made again\n" * 2


@pytest.fixture
def context(tmp_path: Path) -> JobContext:
    text = TEXT.replace("edge_length_mm = 1.25", 'solver = "batched", cells = [4, 4, 2]')
    return job_context(load_scene(write_tiny(tmp_path, text)), 2, tmp_path / "d")


def test_one_thread_each_leaves_the_environment(monkeypatch) -> None:
    monkeypatch.setenv(THREADS[0], "3")
    monkeypatch.delenv(THREADS[1], raising=False)
    with one_thread_each():
        assert [os.environ[name] for name in THREADS] == ["1"] * len(THREADS)
    assert os.environ[THREADS[0]] == "3"
    assert THREADS[1] not in os.environ


@pytest.mark.skipif(not HAS_PROC, reason="reads child processes' environment in Linux's /proc")
def test_finishing_workers_use_one_thread_each(context: JobContext, tmp_path: Path, monkeypatch) -> None:
    """Fifteen of them beside a solver would fight for the cores."""
    for name in THREADS:
        monkeypatch.setenv(name, "7")
    (tmp_path / "d" / "samples").mkdir(parents=True)
    outcomes = outcomes_of_batches(context, iter([(0, (0, 1))]), 2, 1)
    assert len(next(outcomes).entries) == 2
    workers = workers_of(os.getpid())
    assert workers
    for worker in workers:
        variables = Path(f"/proc/{worker}/environ").read_bytes().split(b"\0")
        for name in THREADS:
            assert f"{name}=1".encode() in variables
    outcomes.close()
    assert os.environ[THREADS[0]] == "7"
