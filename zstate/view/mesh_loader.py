"""Loads meshes on a background thread, so that reading files does not delay the picture."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from zstate.model.geometry import Color, Shape
from zstate.view.mesh_paths import MissingFile
from zstate.view.meshes import MeshAsset, Meshes


@dataclass(frozen=True, eq=False)
class MeshRequest:
    """A shape to load in its own colours, or all in the colour ``over``. Requests compare by identity.

    ``base`` is the folder of the URDF file, if the user named one.
    """

    shape: Shape
    over: Color | None = None
    base: Path | None = None


@dataclass(frozen=True, eq=False)
class LoadedMesh:
    """The result of a request; ``defects`` are a texture or a colour that it lacks."""

    request: MeshRequest
    asset: MeshAsset | MissingFile
    defects: tuple[MissingFile, ...] = ()


class MeshLoader:
    """Loads meshes on a background thread that exits when its queue is empty."""

    def __init__(self, meshes: Meshes) -> None:
        self._meshes = meshes
        self._lock = threading.Lock()
        self._queue: list[MeshRequest] = []
        self._loaded: queue.SimpleQueue[LoadedMesh] = queue.SimpleQueue()
        self._running = False
        self._open = 0

    @property
    def busy(self) -> bool:
        """Whether a requested mesh has not been fetched yet."""
        return self._open > 0

    def request(self, requests: list[MeshRequest]) -> None:
        """Queue requests."""
        with self._lock:
            self._queue += requests
            self._open += len(requests)
            if self._queue and not self._running:
                self._running = True
                threading.Thread(target=self._run, name="zstate-meshes", daemon=True).start()

    def cancel(self, requests: Iterable[MeshRequest]) -> None:
        """Drop requests that are still queued."""
        cancelled = set(requests)
        with self._lock:
            kept = [request for request in self._queue if request not in cancelled]
            self._open -= len(self._queue) - len(kept)
            self._queue = kept

    def fetch(self) -> Iterator[LoadedMesh]:
        """The meshes loaded since the last call."""
        while not self._loaded.empty():
            self._open -= 1
            yield self._loaded.get()

    def _run(self) -> None:
        while True:
            with self._lock:
                if not self._queue:
                    self._running = False
                    return
                request = self._queue.pop(0)
            self._loaded.put(self._load(request))

    def _load(self, request: MeshRequest) -> LoadedMesh:
        try:
            asset = self._meshes.load(request.shape, request.over, request.base)
            defects = [asset.defect if isinstance(asset, MeshAsset) else None]
            if request.over is None:
                defects.insert(0, self._meshes.missing_texture(request.shape, request.base))
        except Exception as error:  # one unforeseen file must not stop the others
            reason = f"{type(error).__name__}: {error}"
            return LoadedMesh(request, MissingFile(str(request.shape.geometry), reason))
        return LoadedMesh(request, asset, tuple(one for one in defects if one is not None))
