"""Stores of recordings, such as an archive of months, which commands open where they take a file.

A plugin brings one: its row ``store`` names a class like ``RecordingStore``.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple, Protocol

from zstate.errors import InvalidInput
from zstate.plugins import built_in_plugins


class RecordingStore(Protocol):
    """The store ``name``, a folder or a URL; it need not exist before a recording is added."""

    def __init__(self, name: str, /) -> None: ...

    @staticmethod
    def is_store(name: str) -> bool:
        """Whether ``name`` is such a store, and no recording."""
        ...

    def write_window(self, path: Path, robot: str, start: int, end: int) -> None:
        """Write what it has of ``robot`` from ``start`` to ``end`` [ns] as a recording into ``path``.

        Raises InvalidInput for a robot or a window that it does not have, and RecordingError.
        """
        ...

    def check(self) -> None:
        """Raise a ZStateError if it cannot be used."""
        ...

    def add(self, path: Path) -> None:
        """Add the recording ``path``; if it has it already, nothing is added. Raises a ZStateError."""
        ...


def store_types() -> list[type[RecordingStore]]:
    """The kinds of stores that plugins bring."""
    references = [plugin.store.partition(":") for plugin in built_in_plugins() if plugin.store]
    return [getattr(import_module(module), name) for module, _, name in references]


def find_store(name: str) -> RecordingStore | None:
    """The store ``name``; None if it is none, but perhaps a recording."""
    return next((kind(name) for kind in store_types() if kind.is_store(name)), None)


def new_store(name: str) -> RecordingStore:
    """The store ``name``, which may have no recording yet. Raises InvalidInput if no plugin brings one."""
    for kind in store_types():
        return kind(name)
    raise InvalidInput(f"no plugin of zstate keeps recordings in {name!r}: `zstate plugins` lists them")


class OpenedPath(NamedTuple):
    """The ``path`` of a recording, and the name, such as "r1.mcap", after which others are ``named``."""

    path: Path
    named: Path


@contextmanager
def opened_path(
    name: str, robot: str | None, window: tuple[int, int] | None
) -> Generator[OpenedPath, None, None]:
    """The recording ``name`` itself, or a temporary one with a ``window`` [ns] of a store.

    Raises InvalidInput for a store without ``robot`` or ``window``, and for a file with a window.
    """
    store = find_store(name)
    if store is None:
        if window is not None:
            raise InvalidInput(f"{name!r} is no archive: --at, --from and --to name a window of an archive")
        yield OpenedPath(Path(name), Path(name))
        return
    if robot is None or window is None:
        raise InvalidInput(
            f"{name!r} is an archive: name one robot of it, and a window by --at TIME, or by --from TIME "
            f"--to TIME; `zstate archive {name}` lists the robots"
        )
    with TemporaryDirectory(prefix="zstate-window-") as folder:
        path = Path(folder, f"{robot.replace('/', '_')}.mcap")
        store.write_window(path, robot, *window)
        yield OpenedPath(path, Path(path.name))
