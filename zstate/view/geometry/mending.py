"""COLLADA files with materials that are not there: they are read without these, rather than not at all."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import collada  # pyright: ignore[reportMissingTypeStubs]

_Collada: Any = collada.Collada  # not typed


def without_lost_materials(path: Path) -> io.BytesIO:
    """The file without references to materials that cannot be read.

    pycollada leaves out the whole mesh where one of its materials misses an effect, or that its image.
    """
    readable = {f"#{material.id}" for material in _Collada(str(path), ignore=[collada.DaeError]).materials}
    document = ElementTree.parse(path)
    for above in document.iter():
        for one in list(above):
            if one.tag.endswith("instance_material") and one.get("target") not in readable:
                above.remove(one)
    mended = io.BytesIO()
    document.write(mended)
    mended.seek(0)
    return mended
