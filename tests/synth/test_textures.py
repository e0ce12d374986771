"""What the driver of a batched job prepares beside rendering, and the threads that it leaves to its workers."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from processes_of import HAS_PROC, workers_of
from tiny_scene import TEXT, job_context, own_cache, write_tiny

from synth.arrays import Image
from synth.pipeline import textures
from synth.pipeline.overlapped import outcomes_of_batches
from synth.pipeline.records import JobContext
from synth.pipeline.threads import THREADS, one_thread_each
from synth.scene import Sensor
from synth.scene.template import load_scene


@pytest.fixture
def context(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> JobContext:
    own_cache(monkeypatch)
    text = TEXT.replace("edge_length_mm = 1.25", 'solver = "batched"\ncells = [4, 4, 2]')
    return job_context(load_scene(write_tiny(tmp_path, text)), 2, tmp_path / "d")


def test_textures_are_painted_in_order_and_few_at_a_time(context: JobContext, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[int] = []
    lock = threading.Lock()

    def painted(_: JobContext, sensor: int, scene: Sensor) -> Image:
        with lock:
            begun.append(sensor)
        if sensor == 5:
            raise MemoryError("no room for sensor 5")
        return np.full((1, 1, 3), sensor, dtype=np.float32)

    monkeypatch.setattr(textures, "paint", painted)
    scene = context.plan.template.corners[0].sensor
    with ThreadPoolExecutor(1) as threads:
        early = textures.Textures(context, threads, room=2)
        asked = [early.request(sensor, scene) for sensor in range(6)]
        for sensor, texture in enumerate(asked[:5]):
            assert texture.result(10)[0, 0, 0] == sensor
            assert begun == list(range(len(begun)))
            assert len(begun) <= sensor + 2
            early.release()
        with pytest.raises(MemoryError, match="sensor 5"):
            asked[5].result(10)


def test_one_thread_each_leaves_the_environment_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
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
