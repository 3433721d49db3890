"""Clouds as documents, which `zstate echo` prints."""

from __future__ import annotations

from typing import Any

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
