"""Definitions of the ROS 2 messages that zstate uses, for oracles that do not have them."""

from __future__ import annotations

from pathlib import Path

FIELDS = {
    "builtin_interfaces/msg/Time": ("int32 sec", "uint32 nanosec"),
    "std_msgs/msg/Header": ("builtin_interfaces/Time stamp", "string frame_id"),
    "std_msgs/msg/String": ("string data",),
    "std_msgs/msg/MultiArrayDimension": ("string label", "uint32 size", "uint32 stride"),
    "std_msgs/msg/MultiArrayLayout": ("MultiArrayDimension[] dim", "uint32 data_offset"),
    "std_msgs/msg/Float64MultiArray": ("MultiArrayLayout layout", "float64[] data"),
    "builtin_interfaces/msg/Duration": ("int32 sec", "uint32 nanosec"),
    "trajectory_msgs/msg/JointTrajectoryPoint": (
        "float64[] positions",
        "float64[] velocities",
        "float64[] accelerations",
        "float64[] effort",
        "builtin_interfaces/Duration time_from_start",
    ),
    "trajectory_msgs/msg/JointTrajectory": (
        "std_msgs/Header header",
        "string[] joint_names",
        "JointTrajectoryPoint[] points",
    ),
    "rosgraph_msgs/msg/Clock": ("builtin_interfaces/Time clock",),
    "sensor_msgs/msg/JointState": (
        "std_msgs/Header header",
        "string[] name",
        "float64[] position",
        "float64[] velocity",
        "float64[] effort",
    ),
    "geometry_msgs/msg/Vector3": ("float64 x", "float64 y", "float64 z"),
    "geometry_msgs/msg/Quaternion": ("float64 x 0", "float64 y 0", "float64 z 0", "float64 w 1"),
    "geometry_msgs/msg/Transform": ("Vector3 translation", "Quaternion rotation"),
    "geometry_msgs/msg/TransformStamped": (
        "std_msgs/Header header",
        "string child_frame_id",
        "Transform transform",
    ),
    "tf2_msgs/msg/TFMessage": ("geometry_msgs/TransformStamped[] transforms",),
    "sensor_msgs/msg/LaserScan": (
        "std_msgs/Header header",
        "float32 angle_min",
        "float32 angle_max",
        "float32 angle_increment",
        "float32 time_increment",
        "float32 scan_time",
        "float32 range_min",
        "float32 range_max",
        "float32[] ranges",
        "float32[] intensities",
    ),
    "geometry_msgs/msg/Point": ("float64 x", "float64 y", "float64 z"),
    "geometry_msgs/msg/Pose": ("Point position", "Quaternion orientation"),
    "nav_msgs/msg/MapMetaData": (
        "builtin_interfaces/Time map_load_time",
        "float32 resolution",
        "uint32 width",
        "uint32 height",
        "geometry_msgs/Pose origin",
    ),
    "nav_msgs/msg/OccupancyGrid": ("std_msgs/Header header", "MapMetaData info", "int8[] data"),
}


def write_messages(folder: Path, *names: str) -> None:
    """Writes ``<folder>/<package>/msg/<Type>.msg`` for each of ``names``; default: all."""
    for name in names or FIELDS:
        path = folder / f"{name}.msg"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(FIELDS[name]) + "\n")
