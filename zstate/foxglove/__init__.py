"""Live robots in Foxglove, by its WebSocket protocol. Raises LibraryMissing on import without websockets."""

from __future__ import annotations

from zstate.errors import LibraryMissing

try:
    import websockets.asyncio.server  # noqa: F401  # pyright: ignore[reportUnusedImport]
except ImportError as error:
    raise LibraryMissing(
        f"serving Foxglove needs websockets, which cannot be loaded ({error}): pip install 'zstate[foxglove]'"
    ) from None
