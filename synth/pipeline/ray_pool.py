"""Tasks spread over a Ray cluster.

A task is one trajectory: it depends on (scene, seed, trajectory) alone and shares nothing with others but the output,
where its samples appear whole or not at all. So Ray may repeat it when a worker or a machine is lost, and even have it
done twice at once. The driver records what comes back, as with worker processes (`worker_pool`); a lost driver
loses the tasks under way, and the same command goes on.

Every machine needs this package installed and must see the output: a directory on a shared file system, or a URL.
Reference: https://docs.ray.io/en/latest/ray-core/fault_tolerance/tasks.html
"""

import os
import socket
import uuid
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from typing import Any

from synth.errors import InputError
from synth.pipeline.producer import Producer
from synth.pipeline.records import JobContext, Outcome, Task
from synth.pipeline.worker_pool import render_on_one_core

LOCAL = "local"
"""The address that means: a cluster of worker processes on this machine, for as long as the command runs."""

MAX_RETRIES = 3
"""Repetitions of a task whose worker or machine was lost."""

CONNECT_S = 10.0
"""Seconds in which a cluster's address must answer."""

GPU_SHARE = 0.25
"""Share of a GPU that a task asks for: simulation on the processor, encoding and writing leave it idle mostly."""


def outcomes_of_ray(
    context: JobContext, tasks: Iterator[Task], address: str, workers: int | None
) -> Generator[Outcome, None, None]:
    """Outcomes in the order in which they are ready; at most two tasks per processor core are waiting at any time.

    The address is as `ray.init` takes it, or "local"; `workers` limits the tasks at once, by default to the cluster's
    cores. InputError where Ray is not installed, there is no such cluster, it has no GPU where one is needed, the
    storage refuses, or a task's worker was lost again and again.
    """
    ray = _ray()
    gpus = GPU_SHARE if context.plan.variant.is_on_gpu else 0
    with _cluster(ray, address, workers):
        if gpus and not ray.cluster_resources().get("GPU"):
            raise InputError(f"--ray {address}: the cluster has no GPU; give --device cpu, or add one")
        work = ray.remote(max_retries=MAX_RETRIES, num_cpus=1, num_gpus=gpus)(_work)
        shared, token = ray.put(context), uuid.uuid4().hex
        under_way: dict[Any, Task] = {}
        while True:
            most = workers or 2 * max(1, int(ray.cluster_resources().get("CPU", 1)))
            while len(under_way) < most and (task := next(tasks, None)) is not None:
                under_way[work.remote(shared, token, *task)] = task
            if not under_way:
                return
            done, _ = ray.wait(list(under_way), num_returns=1)
            trajectory, _ = under_way.pop(done[0])
            yield _result(ray, done[0], trajectory)


def _result(ray: Any, reference: Any, trajectory: int) -> Outcome:
    try:
        outcome: Outcome = ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, InputError):
            raise InputError(str(error.cause)) from error
        raise
    except ray.exceptions.RayError as error:
        raise InputError(
            f"trajectory {trajectory}: its worker was lost {MAX_RETRIES + 1} times ({type(error).__name__}: out of "
            "memory, or killed); finished samples are kept: give the same command again to go on"
        ) from error
    return outcome


@contextmanager
def _cluster(ray: Any, address: str, workers: int | None) -> Iterator[None]:
    """Connected to a cluster; one that was begun here ends here."""
    begun = not ray.is_initialized()
    if begun:
        _check_reachable(address)
        where: dict[str, Any] = {"address": address}
        if address == LOCAL:
            where = {"address": LOCAL, "num_cpus": workers, "include_dashboard": False}
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # a cluster that we begin tells nobody
        try:
            ray.init(**where, log_to_driver=False, logging_level="error")
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise InputError(f"--ray {address}: {str(error).splitlines()[0]}") from error
    try:
        yield
    finally:
        if begun:
            ray.shutdown()


def _check_reachable(address: str) -> None:
    """Ray itself tries for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not (host and port.isdecimal()):
        return
    try:
        socket.create_connection((host, int(port)), CONNECT_S).close()
    except OSError as error:
        raise InputError(f"--ray {address}: there is no cluster: {error.strerror or error}") from error


def _ray() -> Any:
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise InputError("--ray needs Ray: pip install 'gelflow-synth[cluster]'") from error
    return ray


_producer: tuple[str, Producer] | None = None
"""A worker process's producer and the run that it belongs to: Ray gives a worker many tasks."""


def _work(context: JobContext, token: str, trajectory: int, wanted: tuple[int, ...]) -> Outcome:
    global _producer
    if _producer is None or _producer[0] != token:
        render_on_one_core(context.plan)  # Ray itself keeps linear algebra to a task's one core
        _producer = token, Producer(context)
    return _producer[1].produce(trajectory, wanted)
