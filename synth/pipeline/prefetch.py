"""Prefetching: an iterator that runs in a thread of its own, some items ahead of whoever takes them."""

import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from queue import Full, Queue
from typing import TypeVar

Item = TypeVar("Item")

POLL_S = 0.1
"""Seconds after which a thread that waits for room looks whether it is still wanted."""
JOIN_S = 10.0
"""Seconds that the thread is given for its last item, when it is no longer wanted."""


@contextmanager
def prefetched(items: Iterable[Item], limit: int) -> Iterator[Iterator[Item]]:
    """Take items, in their order, from an iterator that runs in another thread; what it raises is raised here.

    When `limit` items wait to be taken, the other thread waits. On leaving, it is told to stop after its present item.
    """
    queue: Queue[tuple[Item] | BaseException | None] = Queue(limit)
    cancelled = threading.Event()

    def put(entry: tuple[Item] | BaseException | None) -> None:
        while not cancelled.is_set():
            try:
                queue.put(entry, timeout=POLL_S)
            except Full:
                continue
            return

    def run() -> None:
        try:
            for item in items:
                put((item,))
                if cancelled.is_set():
                    return
        except BaseException as error:  # whatever it is, it belongs to the thread that takes
            put(error)
        put(None)

    def in_order() -> Iterator[Item]:
        while (entry := queue.get()) is not None:
            if isinstance(entry, BaseException):
                raise entry
            yield entry[0]

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield in_order()
    finally:
        cancelled.set()
        thread.join(JOIN_S)
