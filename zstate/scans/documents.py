"""Scans and maps as documents, which `zstate echo` prints."""

from __future__ import annotations

from typing import Any

import numpy as np

from zstate.scans.grid import grid_from_message
from zstate.scans.map_files import SAVED_FREE, SAVED_OCCUPIED
from zstate.scans.messages import LaserScan, OccupancyGrid
from zstate.scans.scan import scan_from_message


def scan_document(message: LaserScan, robot: str) -> dict[str, Any]:
    """A scan of ``robot`` as a document: stamp [ns], angles [rad], limits [m], and what it measured."""
    scan = scan_from_message(message, robot)
    measured = scan.ranges[scan.valid].astype(float)
    return {
        "stamp": scan.stamp,
        "seq": message.seq,
        "frame": scan.frame,
        "angle_min": scan.angle_min,
        "angle_increment": scan.angle_increment,
        "ray_ns": scan.ray_ns,
        "range_min": scan.range_min,
        "range_max": scan.range_max,
        "rays": len(scan.ranges),
        "valid": len(measured),
        "nearest": measured.min().item() if measured.size else np.nan,
        "farthest": measured.max().item() if measured.size else np.nan,
    }


def full_scan_document(message: LaserScan, robot: str) -> dict[str, Any]:
    """The same with the range of each ray [m], NaN if it is no measurement."""
    scan = scan_from_message(message, robot)
    ranges = np.where(scan.valid, scan.ranges.astype(float), np.nan)
    return {**scan_document(message, robot), "ranges": ranges.tolist()}


def map_document(message: OccupancyGrid, robot: str) -> dict[str, Any]:
    """A map of ``robot`` as a document: stamp [ns], geometry [m] and counts of cells.

    As in files of map_saver, cells from 65 are occupied, those from 0 to 25 free, all others unknown.
    """
    grid = grid_from_message(message, robot)
    height, width = grid.cells.shape
    occupied = int(np.count_nonzero(grid.cells >= SAVED_OCCUPIED))
    free = int(np.count_nonzero((grid.cells >= 0) & (grid.cells <= SAVED_FREE)))
    return {
        "stamp": grid.stamp,
        "frame": grid.frame,
        "resolution": grid.resolution,
        "width": width,
        "height": height,
        "size": list(grid.size),
        "origin": {
            "translation": grid.origin.translation.tolist(),
            "rotation": grid.origin.rotation.tolist(),
        },
        "occupied": occupied,
        "free": free,
        "unknown": grid.cells.size - occupied - free,
    }
