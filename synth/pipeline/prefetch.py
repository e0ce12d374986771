"""Prefetching: an iterator that runs in a thread of its own, some items ahead of whoever takes them."""

import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from queue import Full, Queue
from typing import Generic, TypeVar

Item = TypeVar("Item")

POLL_S = 0.1
"""Seconds after which a thread that waits for room looks whether it is still wanted."""
JOIN_S = 10.0
"""For its last item, when it is no longer wanted."""


@dataclass(frozen=True)
class _End:
    """The last thing in the queue: how the iterator ended."""

    error: BaseException | None


@contextmanager
def prefetched(items: Iterable[Item], limit: int) -> Iterator[Iterator[Item]]:
    """Take items from an iterator that runs in another thread; what it raises is raised here.

    Args:
        items: are made in the other thread.
        limit: that wait to be taken; when there are so many, the other thread waits.

    Yields:
        The items in their order. On leaving, the thread is told to stop after the item that it is making.
    """
    prefetcher = _Prefetcher(items, Queue(limit), threading.Event())
    thread = threading.Thread(target=prefetcher.run, daemon=True)
    thread.start()
    try:
        yield prefetcher.items_in_order()
    finally:
        prefetcher.cancelled.set()
        thread.join(JOIN_S)


@dataclass(frozen=True)
class _Prefetcher(Generic[Item]):
    items: Iterable[Item]
    queue: "Queue[Item | _End]"
    cancelled: threading.Event

    def run(self) -> None:
        error: BaseException | None = None
        try:
            for item in self.items:
                if not self._put(item):
                    return
        except BaseException as raised:  # whatever it is, it belongs to the thread that takes
            error = raised
        self._put(_End(error))

    def _put(self, item: Item | _End) -> bool:
        while not self.cancelled.is_set():
            try:
                self.queue.put(item, timeout=POLL_S)
            except Full:
                continue
            return True
        return False

    def items_in_order(self) -> Iterator[Item]:
        while True:
            item = self.queue.get()
            if isinstance(item, _End):
                if item.error is not None:
                    raise item.error
                return
            yield item
