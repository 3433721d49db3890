"""ROS 2 message types of the streams: names, fields, and type hashes (REP-2016)."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from hashlib import sha256
from typing import Any, NamedTuple, TypeAlias

Fields: TypeAlias = tuple[tuple[str, str], ...]
"""The type and the name of each field of a message, in the notation of .msg files."""

# By package/type.
_FIELDS: dict[str, Fields] = {
    "builtin_interfaces/Time": (("int32", "sec"), ("uint32", "nanosec")),
    "std_msgs/Header": (("builtin_interfaces/Time", "stamp"), ("string", "frame_id")),
    "std_msgs/String": (("string", "data"),),
    "std_msgs/MultiArrayDimension": (("string", "label"), ("uint32", "size"), ("uint32", "stride")),
    "std_msgs/MultiArrayLayout": (("std_msgs/MultiArrayDimension[]", "dim"), ("uint32", "data_offset")),
    "std_msgs/Float64MultiArray": (("std_msgs/MultiArrayLayout", "layout"), ("float64[]", "data")),
    "builtin_interfaces/Duration": (("int32", "sec"), ("uint32", "nanosec")),
    "trajectory_msgs/JointTrajectoryPoint": (
        *(("float64[]", name) for name in ("positions", "velocities", "accelerations", "effort")),
        ("builtin_interfaces/Duration", "time_from_start"),
    ),
    "trajectory_msgs/JointTrajectory": (
        ("std_msgs/Header", "header"),
        ("string[]", "joint_names"),
        ("trajectory_msgs/JointTrajectoryPoint[]", "points"),
    ),
    "diagnostic_msgs/KeyValue": (("string", "key"), ("string", "value")),
    "diagnostic_msgs/DiagnosticStatus": (
        ("byte", "level"),
        *(("string", name) for name in ("name", "message", "hardware_id")),
        ("diagnostic_msgs/KeyValue[]", "values"),
    ),
    "diagnostic_msgs/DiagnosticArray": (
        ("std_msgs/Header", "header"),
        ("diagnostic_msgs/DiagnosticStatus[]", "status"),
    ),
    "rosgraph_msgs/Clock": (("builtin_interfaces/Time", "clock"),),
    "sensor_msgs/JointState": (
        ("std_msgs/Header", "header"),
        ("string[]", "name"),
        ("float64[]", "position"),
        ("float64[]", "velocity"),
        ("float64[]", "effort"),
    ),
    "sensor_msgs/LaserScan": (
        ("std_msgs/Header", "header"),
        *(("float32", name) for name in ("angle_min", "angle_max", "angle_increment")),
        *(("float32", name) for name in ("time_increment", "scan_time", "range_min", "range_max")),
        ("float32[]", "ranges"),
        ("float32[]", "intensities"),
    ),
    "sensor_msgs/PointField": (
        *(("string", "name"), ("uint32", "offset")),
        *(("uint8", "datatype"), ("uint32", "count")),
    ),
    "sensor_msgs/PointCloud2": (
        ("std_msgs/Header", "header"),
        *(("uint32", "height"), ("uint32", "width")),
        ("sensor_msgs/PointField[]", "fields"),
        ("bool", "is_bigendian"),
        *(("uint32", "point_step"), ("uint32", "row_step")),
        ("uint8[]", "data"),
        ("bool", "is_dense"),
    ),
    "sensor_msgs/CompressedImage": (
        ("std_msgs/Header", "header"),
        ("string", "format"),
        ("uint8[]", "data"),
    ),
    "foxglove_msgs/CompressedVideo": (
        ("builtin_interfaces/Time", "timestamp"),
        ("string", "frame_id"),
        ("uint8[]", "data"),
        ("string", "format"),
    ),
    "sensor_msgs/Image": (
        ("std_msgs/Header", "header"),
        ("uint32", "height"),
        ("uint32", "width"),
        ("string", "encoding"),
        ("uint8", "is_bigendian"),
        ("uint32", "step"),
        ("uint8[]", "data"),
    ),
    "sensor_msgs/RegionOfInterest": (
        *(("uint32", name) for name in ("x_offset", "y_offset", "height", "width")),
        ("bool", "do_rectify"),
    ),
    "sensor_msgs/CameraInfo": (
        ("std_msgs/Header", "header"),
        ("uint32", "height"),
        ("uint32", "width"),
        ("string", "distortion_model"),
        ("float64[]", "d"),
        ("float64[9]", "k"),
        ("float64[9]", "r"),
        ("float64[12]", "p"),
        ("uint32", "binning_x"),
        ("uint32", "binning_y"),
        ("sensor_msgs/RegionOfInterest", "roi"),
    ),
    "nav_msgs/MapMetaData": (
        ("builtin_interfaces/Time", "map_load_time"),
        ("float32", "resolution"),
        ("uint32", "width"),
        ("uint32", "height"),
        ("geometry_msgs/Pose", "origin"),
    ),
    "nav_msgs/OccupancyGrid": (
        ("std_msgs/Header", "header"),
        ("nav_msgs/MapMetaData", "info"),
        ("int8[]", "data"),
    ),
    "geometry_msgs/Vector3": (("float64", "x"), ("float64", "y"), ("float64", "z")),
    "geometry_msgs/Quaternion": (("float64", "x"), ("float64", "y"), ("float64", "z"), ("float64", "w")),
    "geometry_msgs/Transform": (
        ("geometry_msgs/Vector3", "translation"),
        ("geometry_msgs/Quaternion", "rotation"),
    ),
    "geometry_msgs/TransformStamped": (
        ("std_msgs/Header", "header"),
        ("string", "child_frame_id"),
        ("geometry_msgs/Transform", "transform"),
    ),
    "tf2_msgs/TFMessage": (("geometry_msgs/TransformStamped[]", "transforms"),),
    "geometry_msgs/Point": (("float64", "x"), ("float64", "y"), ("float64", "z")),
    "geometry_msgs/Pose": (("geometry_msgs/Point", "position"), ("geometry_msgs/Quaternion", "orientation")),
    "geometry_msgs/PoseWithCovariance": (("geometry_msgs/Pose", "pose"), ("float64[36]", "covariance")),
    "geometry_msgs/PoseWithCovarianceStamped": (
        ("std_msgs/Header", "header"),
        ("geometry_msgs/PoseWithCovariance", "pose"),
    ),
    "geometry_msgs/Twist": (("geometry_msgs/Vector3", "linear"), ("geometry_msgs/Vector3", "angular")),
    "geometry_msgs/TwistWithCovariance": (("geometry_msgs/Twist", "twist"), ("float64[36]", "covariance")),
    "geometry_msgs/TwistWithCovarianceStamped": (
        ("std_msgs/Header", "header"),
        ("geometry_msgs/TwistWithCovariance", "twist"),
    ),
    "nav_msgs/Odometry": (
        ("std_msgs/Header", "header"),
        ("string", "child_frame_id"),
        ("geometry_msgs/PoseWithCovariance", "pose"),
        ("geometry_msgs/TwistWithCovariance", "twist"),
    ),
    "sensor_msgs/Imu": (
        ("std_msgs/Header", "header"),
        ("geometry_msgs/Quaternion", "orientation"),
        ("float64[9]", "orientation_covariance"),
        ("geometry_msgs/Vector3", "angular_velocity"),
        ("float64[9]", "angular_velocity_covariance"),
        ("geometry_msgs/Vector3", "linear_acceleration"),
        ("float64[9]", "linear_acceleration_covariance"),
    ),
    "sensor_msgs/NavSatStatus": (("int8", "status"), ("uint16", "service")),
    "sensor_msgs/NavSatFix": (
        ("std_msgs/Header", "header"),
        ("sensor_msgs/NavSatStatus", "status"),
        *(("float64", name) for name in ("latitude", "longitude", "altitude")),
        ("float64[9]", "position_covariance"),
        ("uint8", "position_covariance_type"),
    ),
    "sensor_msgs/FluidPressure": (
        ("std_msgs/Header", "header"),
        ("float64", "fluid_pressure"),
        ("float64", "variance"),
    ),
    "sensor_msgs/MagneticField": (
        ("std_msgs/Header", "header"),
        ("geometry_msgs/Vector3", "magnetic_field"),
        ("float64[9]", "magnetic_field_covariance"),
    ),
}
# The numbers of type_description_interfaces/FieldType.
_NESTED, _ARRAY, _UNBOUNDED_SEQUENCE = 1, 48, 144
_PRIMITIVES = {
    **{"int8": 2, "uint8": 3, "uint16": 5, "int32": 6, "uint32": 7},
    **{"float32": 10, "float64": 11, "bool": 15, "byte": 16, "string": 17},
}

_SEPARATOR = "=" * 80


class RosType(NamedTuple):
    """A message type.

    ``name`` is for instance "std_msgs/msg/String", ``dds`` its form in key expressions, ``hash`` the hash of
    its fields (RIHS01), ``definition`` its .msg files, joined for the schema encoding "ros2msg".
    """

    name: str
    dds: str
    hash: str
    definition: str

    encoding = "cdr"
    schema_encoding = "ros2msg"

    @classmethod
    def from_fields(cls, short: str, fields: Fields | None = None) -> RosType:
        """The type ``short`` (package/type), from its ``fields`` and those of the types within.

        Fields are pairs of a type and a name, as in a .msg file. Those of the types below are known.
        """
        known = _FIELDS if fields is None else {**_FIELDS, short: fields}
        package, kind = short.split("/")
        names = tuple(dict.fromkeys(_with_parts(short, known)))
        # The SHA-256 of the fields in the one form of JSON that REP-2016 prescribes.
        described = {
            "type_description": _description(short, known),
            "referenced_type_descriptions": [_description(part, known) for part in sorted(names[1:])],
        }
        type_hash = f"RIHS01_{sha256(json.dumps(described).encode()).hexdigest()}"
        texts = ["".join(f"{kind} {name}\n" for kind, name in known[part]) for part in names]
        parts = [f"MSG: {part}\n{text}" for part, text in zip(names[1:], texts[1:], strict=True)]
        definition = f"{_SEPARATOR}\n".join([texts[0], *parts])
        return cls(_full(short), f"{package}::msg::dds_::{kind}_", type_hash, definition)


def _full(short: str) -> str:
    return short.replace("/", "/msg/")


def _with_parts(short: str, known: Mapping[str, Fields]) -> Iterator[str]:
    """A type, then recursively the types of its fields; some more than once."""
    yield short
    for kind, _ in known[short]:
        if (part := kind.partition("[")[0]) in known:
            yield from _with_parts(part, known)


def _description(short: str, known: Mapping[str, Fields]) -> dict[str, Any]:
    fields: list[dict[str, Any]] = []
    for kind, name in known[short]:
        item, bracket, length = kind.removesuffix("]").partition("[")
        several = 0 if not bracket else _ARRAY if length else _UNBOUNDED_SEQUENCE
        field_type = {
            "type_id": _PRIMITIVES.get(item, _NESTED) + several,
            "capacity": int(length or 0),
            "string_capacity": 0,
            "nested_type_name": _full(item) if item in known else "",
        }
        fields.append({"name": name, "type": field_type})
    return {"type_name": _full(short), "fields": fields}


JOINT_STATE = RosType.from_fields("sensor_msgs/JointState")
TF_MESSAGE = RosType.from_fields("tf2_msgs/TFMessage")
STRING = RosType.from_fields("std_msgs/String")
LASER_SCAN = RosType.from_fields("sensor_msgs/LaserScan")
POINT_CLOUD2 = RosType.from_fields("sensor_msgs/PointCloud2")
COMPRESSED_IMAGE = RosType.from_fields("sensor_msgs/CompressedImage")
COMPRESSED_VIDEO = RosType.from_fields("foxglove_msgs/CompressedVideo")
IMAGE = RosType.from_fields("sensor_msgs/Image")
CAMERA_INFO = RosType.from_fields("sensor_msgs/CameraInfo")
OCCUPANCY_GRID = RosType.from_fields("nav_msgs/OccupancyGrid")
CLOCK = RosType.from_fields("rosgraph_msgs/Clock")
FLOAT64_MULTI_ARRAY = RosType.from_fields("std_msgs/Float64MultiArray")
DIAGNOSTIC_ARRAY = RosType.from_fields("diagnostic_msgs/DiagnosticArray")
JOINT_TRAJECTORY = RosType.from_fields("trajectory_msgs/JointTrajectory")
POSE_WITH_COVARIANCE = RosType.from_fields("geometry_msgs/PoseWithCovarianceStamped")
TWIST_WITH_COVARIANCE = RosType.from_fields("geometry_msgs/TwistWithCovarianceStamped")
ODOMETRY = RosType.from_fields("nav_msgs/Odometry")
IMU = RosType.from_fields("sensor_msgs/Imu")
FLUID_PRESSURE = RosType.from_fields("sensor_msgs/FluidPressure")
NAV_SAT_FIX = RosType.from_fields("sensor_msgs/NavSatFix")
MAGNETIC_FIELD = RosType.from_fields("sensor_msgs/MagneticField")
