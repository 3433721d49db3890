"""Browser view of robots and frames, drawn with viser."""

from __future__ import annotations

from zstate.errors import LibraryMissing


def check_libraries() -> None:
    """Raise LibraryMissing without what draws robots."""
    try:
        import collada  # noqa: F401, PLC0415  # pyright: ignore[reportMissingTypeStubs, reportUnusedImport]
        import trimesh  # noqa: F401, PLC0415  # pyright: ignore[reportMissingTypeStubs, reportUnusedImport]
        import viser  # noqa: F401, PLC0415  # pyright: ignore[reportUnusedImport]
    except ImportError as error:
        raise LibraryMissing(
            f"the view needs viser, trimesh and pycollada, and one cannot be loaded ({error}): "
            "pip install 'zstate[view]'"
        ) from None
