"""Clouds as documents, which `zstate echo` prints, and as columns, which `zstate export` writes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from zstate.clouds.cloud import cloud_from_message
from zstate.clouds.messages import PointCloud


def cloud_document(message: PointCloud, robot: str) -> dict[str, Any]:
    """A cloud of ``robot`` as a document: stamps [ns], its shape and fields, and the box of its points [m].

    ``nan`` is how many have no position; they are outside the box, which is None without others.
    """
    cloud = cloud_from_message(message, robot)
    points = cloud.xyz[cloud.valid]
    return {
        "stamp": cloud.stamp,
        "end_stamp": cloud.end_stamp,
        "seq": message.seq,
        "frame": cloud.frame,
        "width": message.width,
        "height": message.height,
        "fields": [field.name for field in message.fields],
        "nan": len(cloud) - len(points),
        "min": points.min(axis=0).tolist() if points.size else None,
        "max": points.max(axis=0).tolist() if points.size else None,
        "is_dense": cloud.is_dense,
        "bytes": cloud.nbytes,
        "compression": message.compression or None,
        "resolution": message.resolution or None,
    }


def cloud_columns(message: PointCloud, robot: str) -> dict[str, NDArray[Any]]:
    """A row for each point: its ``stamp`` [ns], that of its ``cloud`` [ns], and its fields.

    A packed ``rgb`` or ``rgba`` becomes ``red``, ``green`` and ``blue``; a field with several numbers has the
    columns ``name.0``, ``name.1`` ...
    """
    cloud = cloud_from_message(message, robot)
    stamps, colours = cloud.stamps, cloud.rgb
    cloud_stamps = np.full(len(cloud), cloud.stamp)
    columns: dict[str, NDArray[Any]] = {"stamp": cloud_stamps if stamps is None else stamps}
    columns["cloud"] = cloud_stamps
    for name in cloud.points.dtype.names or ():
        if name in ("rgb", "rgba") and colours is not None:
            columns |= dict(zip(("red", "green", "blue"), colours.T, strict=True))
            continue
        values = cloud.points[name].reshape(len(cloud), -1)
        own = f"message.{name}" if name in columns else name
        names = [own] if values.shape[1] == 1 else [f"{own}.{item}" for item in range(values.shape[1])]
        columns |= dict(zip(names, values.T, strict=True))
    return columns
