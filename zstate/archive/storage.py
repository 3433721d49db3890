"""The files of an archive: in a folder, or below a prefix of an object store.

A file is complete when it has its name: in a folder it is written under another one, synchronised with the
disk and renamed; an object store shows an upload once it is finished.
"""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportMissingTypeStubs=false
# pyright: reportUnknownArgumentType=false
# pyarrow has no annotations

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from hashlib import blake2b
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from zstate.errors import LibraryMissing
from zstate.recording.errors import RecordingError

STAGING = ".import-"
"""The beginning of the name of a folder with the files of an import that is not complete."""

_DIGEST_BYTES = 16
_CHUNK = 1 << 20

_REQUESTS = 16
"""To an object store at once."""

T = TypeVar("T")
R = TypeVar("R")


@cache
def arrow(*parts: str) -> Any:
    """The module pyarrow, with its parts fs and parquet, and these. Raises LibraryMissing.

    Those take long to load: dataset loads pandas, and compute takes as long as pyarrow itself.
    """
    try:
        import pyarrow  # noqa: PLC0415 - an extra

        for part in ("fs", "parquet", *parts):
            import_module(f"pyarrow.{part}")
    except ImportError as error:
        raise LibraryMissing(
            f"an archive needs pyarrow, which cannot be loaded ({error}): pip install 'zstate[archive]'"
        ) from None
    return pyarrow


def numbers_of(column: Any) -> NDArray[Any]:
    """The numbers of a column, a pyarrow.ChunkedArray, NaN where there is none.

    They are read in place if they are in one piece. pyarrow's own conversion loads pandas, if it is there.
    """
    if column.null_count or not column.num_chunks:
        return column.to_numpy()
    parts = [np.from_dlpack(chunk) for chunk in column.chunks]
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


class StoredFile(NamedTuple):
    """A file by its path below the archive, with slashes, and its size [bytes]."""

    path: str
    size: int


class Store:
    """The files below ``url``: a folder, or ``s3://BUCKET/PREFIX`` and what else pyarrow.fs has schemes for.

    Errors of the file system are RecordingErrors that name the file. A missing folder is an empty archive.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self.filesystem, self.root = _filesystem(url)

    @property
    def is_local(self) -> bool:
        """Whether it is a folder of this machine."""
        return self.filesystem.type_name == "local"

    def where(self, path: str) -> str:
        """A file as errors name it."""
        return f"{self.url.partition('?')[0].rstrip('/')}/{path}"

    def files(self, folder: str = "") -> list[StoredFile]:
        """All files below ``folder``, by path."""
        found = self._infos(folder, recursive=True)
        return sorted(StoredFile(self._below(info.path), info.size) for info in found if info.is_file)

    def folders(self, folder: str) -> list[str]:
        """The names of the folders in ``folder``, sorted."""
        return sorted(info.base_name for info in self._infos(folder) if not info.is_file)

    def names(self, folder: str) -> list[str]:
        """The names of the files in ``folder``, sorted."""
        return sorted(info.base_name for info in self._infos(folder) if info.is_file)

    def has(self, path: str) -> bool:
        """Whether the file exists."""
        with self._errors(path):
            return bool(self.filesystem.get_file_info(self._full(path)).is_file)

    def read(self, path: str) -> bytes:
        """The content of a file."""
        with self._errors(path), self.filesystem.open_input_stream(self._full(path)) as stream:
            return stream.read()

    @contextmanager
    def opened(self, path: str) -> Generator[Any, None, None]:
        """A file to read at any place, a pyarrow.NativeFile."""
        with self._errors(path), self.filesystem.open_input_file(self._full(path)) as file:
            yield file

    def put(self, source: Path, path: str) -> None:
        """Move the file ``source`` of this machine to ``path``, where it appears as a whole."""
        with self._errors(path):
            if self.is_local:
                target = Path(self._full(path))
                target.parent.mkdir(parents=True, exist_ok=True)
                _synchronise(source)
                source.replace(target)
                for folder in target.parents:  # which may be new, too
                    _synchronise(folder)
                    if str(folder) == self.root:
                        break
                return
            with source.open("rb") as file, self.filesystem.open_output_stream(self._full(path)) as stream:
                while chunk := file.read(_CHUNK):
                    stream.write(chunk)
        source.unlink()

    def remove(self, paths: Iterable[str]) -> None:
        """Remove files, and the folders that are empty then."""
        for path in paths:
            with self._errors(path):
                self.filesystem.delete_file(self._full(path))
                if self.is_local:
                    _remove_empty(Path(self._full(path)).parent, Path(self.root))

    @contextmanager
    def staging(self, name: str) -> Generator[Path, None, None]:
        """A folder of this machine for the files of one import, which is removed at the end.

        For an archive in a folder it is a hidden one there, on the same disk: one that a killed import of
        the same ``name`` left is emptied.
        """
        if self.is_local:
            folder = Path(self.root) / f"{STAGING}{name}"
            with self._errors(folder.name):
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir(parents=True)
        else:
            folder = Path(tempfile.mkdtemp(prefix="zstate-archive-"))
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def in_threads(self, call: Callable[[T], R], arguments: Sequence[T]) -> list[R]:
        """``in_threads``, with more of them for an object store, which takes a while for each file."""
        return in_threads(call, arguments, None if self.is_local else _REQUESTS)

    def _infos(self, folder: str, *, recursive: bool = False) -> Sequence[Any]:
        fs = arrow().fs
        selector = fs.FileSelector(self._full(folder), allow_not_found=True, recursive=recursive)
        with self._errors(folder):
            return self.filesystem.get_file_info(selector)

    def _full(self, path: str) -> str:
        return f"{self.root}/{path}" if path else self.root

    def _below(self, full: str) -> str:
        return full.removeprefix(self.root).lstrip("/")

    @contextmanager
    def _errors(self, path: str) -> Generator[None, None, None]:
        where = self.where(path)
        try:
            yield
        except arrow().ArrowInvalid as error:
            raise RecordingError(f"{where!r} is no file of an archive: {error}", path=where) from error
        except OSError as error:
            raise RecordingError(f"{where!r}: {error.strerror or error}", path=where) from error


def in_threads(call: Callable[[T], R], arguments: Sequence[T], threads: int | None = None) -> list[R]:
    """The results of ``call`` for each argument, in their order, by so many ``threads``.

    By default there is one for each processor: Parquet is decoded without the lock of the interpreter.
    """
    if len(arguments) < 2:
        return [call(one) for one in arguments]
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        return list(pool.map(call, arguments))


def _filesystem(url: str) -> tuple[Any, str]:
    fs = arrow().fs
    if "://" not in url:
        return fs.LocalFileSystem(), str(Path(url).expanduser().absolute())
    try:
        filesystem, root = fs.FileSystem.from_uri(url)
    except (OSError, ValueError) as error:  # ArrowInvalid is a ValueError
        raise RecordingError(f"{url!r} cannot be opened as an archive: {error}", path=url) from error
    return filesystem, root.rstrip("/")


def _synchronise(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _remove_empty(folder: Path, root: Path) -> None:
    while folder != root:
        try:
            folder.rmdir()
        except OSError:  # it has other files
            return
        folder = folder.parent


def file_digest(paths: Iterable[Path]) -> str:
    """BLAKE2b of the contents of files of this machine, in hexadecimal digits. Raises RecordingError."""
    digest = blake2b(digest_size=_DIGEST_BYTES)
    for path in paths:
        try:
            with path.open("rb") as file:
                while chunk := file.read(_CHUNK):
                    digest.update(chunk)
        except OSError as error:
            text = f"{str(path)!r} cannot be read: {error.strerror or error}"
            raise RecordingError(text, path=str(path)) from error
    return digest.hexdigest()


def bytes_digest(content: bytes) -> str:
    """The same of ``content``."""
    return blake2b(content, digest_size=_DIGEST_BYTES).hexdigest()
