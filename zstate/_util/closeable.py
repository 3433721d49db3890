"""Base class of resources with ``close()``, and signals that wait for it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from types import TracebackType
from typing import Any, TypeVar

Self = TypeVar("Self", bound="Closeable")


class Closeable(ABC):
    """A resource that is open until ``close()``; a context manager."""

    @abstractmethod
    def close(self) -> None:
        """Release the resource. A second call does nothing."""

    def __enter__(self: Self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __reduce__(self) -> str | tuple[Any, ...]:
        name = type(self).__name__
        raise TypeError(f"a {name} is not copied or pickled: it is open in this process; open one in each")
