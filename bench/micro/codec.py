"""Cost of encoding and decoding ROS 2 messages, compared with rosbags.

    pip install rosbags
    python -m bench.micro.codec

A JointState of 30 joints, positions only and with velocities and efforts, and a TFMessage of 40 edges.
Each side starts and ends with its own representation: zstate with blocks of float64, rosbags with message
objects, created once and not counted. Thread CPU time [us] per call in interleaved rounds; the bytes of both
sides are compared first. "first" is zstate decoding a message of a new layout, value by value.
"""

from __future__ import annotations

import platform
from importlib.metadata import version
from itertools import pairwise
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from bench.micro.timing import Call, mean_times_us
from zstate.wire.messages import to_block
from zstate.wire.ros2.cdr import to_time
from zstate.wire.ros2.decoder import JointStateDecoder, TfMessageDecoder
from zstate.wire.ros2.encoder import JointStateEncoder, TfMessageEncoder
from zstate.wire.ros2.types import JOINT_STATE, TF_MESSAGE

STAMP = 1_700_000_000_123_456_789
ROUNDS = 41
CALLS = 100
STORE = get_typestore(Stores.ROS2_KILTED)


def header(frame_id: str) -> Any:
    """A rosbags header at the stamp."""
    stamp = STORE.types["builtin_interfaces/msg/Time"](*to_time(STAMP))
    return STORE.types["std_msgs/msg/Header"](stamp, frame_id)


def rosbags_calls(name: str, message: Any, payload: bytes) -> dict[str, Call]:
    """The rosbags calls for a message with the bytes ``payload``."""
    assert bytes(STORE.serialize_cdr(message, name)) == payload
    return {
        "rosbags encode": lambda: STORE.serialize_cdr(message, name),
        "rosbags decode": lambda: STORE.deserialize_cdr(payload, name),
    }


def joint_state_calls(count: int, rows: int) -> dict[str, Call]:
    """The compared calls for a JointState with ``rows`` numbers per joint, positions first."""
    names = [f"left_arm_joint_{number}" for number in range(count)]
    arrays = np.random.default_rng(1).normal(size=(rows, count))
    blocks = [to_block(array) for array in arrays]
    encoder, decoder = JointStateEncoder(names, "base_link"), JointStateDecoder()
    payload = encoder.encode(STAMP, *blocks)
    assert decoder.decode(payload)[3 : 3 + rows] == tuple(blocks)
    filled = [*arrays, *[np.empty(0)] * (3 - rows)]
    message = STORE.types[JOINT_STATE.name](header("base_link"), names, *filled)
    return {
        "encode": lambda: encoder.encode(STAMP, *blocks),
        "decode": lambda: decoder.decode(payload),
        "first": lambda: JointStateDecoder().decode(payload),
    } | rosbags_calls(JOINT_STATE.name, message, payload)


def tf_message_calls(count: int) -> dict[str, Call]:
    """The compared calls for a TFMessage of one instant."""
    edges = tuple(pairwise(f"link_number_{number}" for number in range(count + 1)))
    poses = np.random.default_rng(1).normal(size=(count, 7))
    block = to_block(poses)
    encoder, decoder = TfMessageEncoder(edges), TfMessageDecoder()
    payload = encoder.encode(STAMP, block)
    assert decoder.decode(payload).poses == block
    message = STORE.types[TF_MESSAGE.name](
        [stamped(*edge, pose) for edge, pose in zip(edges, poses, strict=True)]
    )
    return {
        "encode": lambda: encoder.encode(STAMP, block),
        "decode": lambda: decoder.decode(payload),
        "first": lambda: TfMessageDecoder().decode(payload),
    } | rosbags_calls(TF_MESSAGE.name, message, payload)


def stamped(parent: str, child: str, pose: np.ndarray) -> Any:
    """A rosbags TransformStamped."""
    x, y, z, *rotation = pose.tolist()
    transform = STORE.types["geometry_msgs/msg/Transform"](
        STORE.types["geometry_msgs/msg/Vector3"](x, y, z),
        STORE.types["geometry_msgs/msg/Quaternion"](*rotation),
    )
    return STORE.types["geometry_msgs/msg/TransformStamped"](header(parent), child, transform)


def main() -> None:
    """Print the table."""
    print(
        f"Python {platform.python_version()}, numpy {np.__version__}, rosbags {version('rosbags')}, ", end=""
    )
    print(f"{platform.machine()}; {ROUNDS} rounds of {CALLS} calls, us of thread CPU time, median (minimum)")
    print(f"{'message':<26}{'does':<8}{'zstate':>16}{'rosbags':>18}{'ratio':>7}{'first':>18}")
    cases = {
        "30 joints, positions": joint_state_calls(30, 1),
        "30 joints, all three": joint_state_calls(30, 3),
        "40 edges": tf_message_calls(40),
        "1 edge": tf_message_calls(1),
    }
    for what, calls in cases.items():
        times = mean_times_us(calls, ROUNDS, CALLS)
        for does in ("encode", "decode"):
            ours, theirs = times[does], times[f"rosbags {does}"]
            ratio = float(np.median(theirs) / np.median(ours))
            first = median_and_minimum(times["first"]) if does == "decode" else ""
            print(
                f"{what:<26}{does:<8}{median_and_minimum(ours):>16}{median_and_minimum(theirs):>18}{ratio:>7.1f}{first:>18}",
                flush=True,
            )


def median_and_minimum(times: np.ndarray) -> str:
    """The median, and the minimum in brackets."""
    return f"{np.median(times):.2f} ({times.min():.2f})"


if __name__ == "__main__":
    main()
