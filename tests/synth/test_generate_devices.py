"""Several GPUs of a machine: processes that each see one of them and make a shard. Here there need not be any."""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from tiny_scene import fingerprint, reference

from synth.errors import InputError
from synth.pipeline.devices import on_devices
from synth.pipeline.generate import Scheduling, Summary, _shard_on_device, generate
from synth.planning import job_variant
from synth.scene.template import load_scene

pytestmark = pytest.mark.usefixtures("one_cache")


def _sees(number: int, progress: Callable[[int, int], None]) -> tuple[int, str, int]:
    progress(number + 1, 10)
    return number, os.environ["CUDA_VISIBLE_DEVICES"], len(os.sched_getaffinity(0))


def _fails(number: int, progress: Callable[[int, int], None]) -> None:
    if number == 1:
        raise InputError("the disk is full")


def _dies(number: int, progress: Callable[[int, int], None]) -> None:
    os._exit(9)


def test_each_process_sees_one_gpu_and_a_share_of_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    told: list[tuple[int, int]] = []
    found = on_devices(_sees, 2, lambda *so_far: told.append(so_far))
    cores = len(os.sched_getaffinity(0))
    assert found == [(0, "3", cores // 2 if cores >= 4 else cores), (1, "5", cores // 2 if cores >= 4 else cores)]
    assert told[-1] == (3, 20)
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "3,5"


def test_what_one_process_refuses_is_raised() -> None:
    with pytest.raises(InputError, match="the disk is full"):
        on_devices(_fails, 2, lambda *_: None)
    with pytest.raises(InputError, match="a GPU's process ended"):
        on_devices(_dies, 2, lambda *_: None)


@pytest.mark.processes
def test_the_shards_of_two_devices_are_the_job(tiny: Path, tmp_path: Path) -> None:
    template, out = load_scene(tiny), tmp_path / "d"
    variant = job_variant(template, "cpu")
    make = partial(_shard_on_device, template, 5, out, 0, variant, Scheduling(devices=2), 2)
    summary = Summary.of_all(on_devices(make, 2, lambda *_: None))
    assert (summary.asked_for, summary.made) == (5, 5)
    assert fingerprint(out) == fingerprint(reference())


def test_devices_that_a_job_cannot_use_are_refused(tiny: Path, tmp_path: Path) -> None:
    template = load_scene(tiny)
    with pytest.raises(InputError, match="--devices = 2: needs GPUs"):
        generate(template, 5, tmp_path / "d", variant=job_variant(template, "cpu"), scheduling=Scheduling(devices=2))
