"""What draws in the browser is there, or what to install."""

from __future__ import annotations

from zstate.errors import LibraryMissing

try:
    import collada  # noqa: F401  # pyright: ignore[reportMissingTypeStubs, reportUnusedImport]
    import trimesh  # noqa: F401  # pyright: ignore[reportMissingTypeStubs, reportUnusedImport]
    import viser
except ImportError as error:
    raise LibraryMissing(
        f"the view needs viser, trimesh and pycollada, and one cannot be loaded ({error}): "
        "pip install 'zstate[view]'"
    ) from None

__all__ = ["viser"]
