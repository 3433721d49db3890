"""Live robots in Foxglove, by its WebSocket protocol."""

from __future__ import annotations

from zstate.errors import LibraryMissing


def check_library() -> None:
    """Raise LibraryMissing without websockets."""
    try:
        import websockets.asyncio.server  # noqa: F401, PLC0415  # pyright: ignore[reportUnusedImport]
    except ImportError as error:
        raise LibraryMissing(
            f"serving Foxglove needs websockets, which cannot be loaded ({error}): "
            "pip install 'zstate[foxglove]'"
        ) from None
