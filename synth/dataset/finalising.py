"""What the writers of datasets have in common: `with` finalises the dataset, and closes it whatever happened."""

from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self


class Finalising(ABC):
    """For `with`: finalises, unless an error is on its way that this might hide, and closes."""

    @abstractmethod
    def finalise(self) -> None:
        """Leave the dataset as a whole."""

    @abstractmethod
    def close(self) -> None:
        """Let other processes write; harmless when repeated."""

    def __enter__(self) -> Self:
        """For `with`."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finalise and close."""
        try:
            if error is None or isinstance(error, KeyboardInterrupt):
                self.finalise()
        finally:
            self.close()
