"""ROS messages in the JSON of the peers: dictionaries with the field names of the .msg files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zstate.transform import Transform

JOINT_STATE = "sensor_msgs/msg/JointState"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
STRING = "std_msgs/msg/String"
CLOCK = "rosgraph_msgs/msg/Clock"
LASER_SCAN = "sensor_msgs/msg/LaserScan"
OCCUPANCY_GRID = "nav_msgs/msg/OccupancyGrid"
NUMBERS = "std_msgs/msg/Float64MultiArray"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"

XYZ, XYZW = ("x", "y", "z"), ("x", "y", "z", "w")
SCAN_NUMBERS = (
    "angle_min",
    "angle_max",
    "angle_increment",
    "time_increment",
    "scan_time",
    "range_min",
    "range_max",
)


def time(stamp: int) -> dict[str, int]:
    return {"sec": stamp // 1_000_000_000, "nanosec": stamp % 1_000_000_000}


def header(stamp: int, frame: str = "") -> dict[str, Any]:
    return {"stamp": time(stamp), "frame_id": frame}


def joint_state(
    stamp: int,
    names: Sequence[str],
    positions: Sequence[float],
    velocities: Sequence[float] = (),
    efforts: Sequence[float] = (),
) -> dict[str, Any]:
    numbers = {"position": list(positions), "velocity": list(velocities), "effort": list(efforts)}
    return {"header": header(stamp), "name": list(names), **numbers}


def numbers(values: Sequence[float]) -> dict[str, Any]:
    return {"layout": {"dim": [], "data_offset": 0}, "data": list(values)}


def trajectory(
    names: Sequence[str], points: Sequence[Sequence[float]], times: Sequence[int]
) -> dict[str, Any]:
    """Positions at ``times`` [ns] after the arrival of the message."""
    rows = [
        {
            "positions": list(point),
            "velocities": [],
            "accelerations": [],
            "effort": [],
            "time_from_start": time(at),
        }
        for point, at in zip(points, times, strict=True)
    ]
    return {"header": header(0), "joint_names": list(names), "points": rows}


def transform_stamped(stamp: int, parent: str, child: str, pose7: Sequence[float]) -> dict[str, Any]:
    numbers = [float(number) for number in pose7]
    pose = {
        "translation": dict(zip(XYZ, numbers[:3], strict=True)),
        "rotation": dict(zip(XYZW, numbers[3:], strict=True)),
    }
    return {"header": header(stamp, parent), "child_frame_id": child, "transform": pose}


def tf_message(*transforms: dict[str, Any]) -> dict[str, Any]:
    return {"transforms": list(transforms)}


def laser_scan(stamp: int, frame: str, numbers: Sequence[float], *arrays: Sequence[float]) -> dict[str, Any]:
    """``numbers`` are those of SCAN_NUMBERS; ``arrays`` the ranges and the intensities."""
    geometry = dict(zip(SCAN_NUMBERS, numbers, strict=True))
    ranges, intensities = map(list, arrays)
    return {"header": header(stamp, frame), **geometry, "ranges": ranges, "intensities": intensities}


def occupancy_grid(
    stamp: int, frame: str, resolution: float, pose7: Sequence[float], cells: Sequence[Sequence[int]]
) -> dict[str, Any]:
    """``cells`` are rows of one length; the map was loaded at its stamp."""
    numbers = [float(number) for number in pose7]
    origin = {
        "position": dict(zip(XYZ, numbers[:3], strict=True)),
        "orientation": dict(zip(XYZW, numbers[3:], strict=True)),
    }
    extent = {"resolution": resolution, "width": len(cells[0]), "height": len(cells)}
    info = {"map_load_time": time(stamp), **extent, "origin": origin}
    return {"header": header(stamp, frame), "info": info, "data": [cell for row in cells for cell in row]}


def edges_of(message: dict[str, Any]) -> dict[tuple[str, str], NDArray[np.float64]]:
    """``parent_from_child`` of each transform, as matrices."""
    return {
        (one["header"]["frame_id"], one["child_frame_id"]): _matrix(one["transform"])
        for one in message["transforms"]
    }


def _matrix(pose: dict[str, dict[str, float]]) -> NDArray[np.float64]:
    pose7 = [*(pose["translation"][axis] for axis in XYZ), *(pose["rotation"][axis] for axis in XYZW)]
    return Transform.from_pose7("parent", "child", pose7).matrix
