"""Independent ROS 2 nodes: literal keys and tokens on a plain Zenoh session, bytes of rosbags.

Nothing here uses zstate's implementation of the ROS wires.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from typing import Any

import zenoh
from helpers.manual_cdr import (
    STORE,
    Edges,
    rosbags_cdr,
    rosbags_joint_state,
    rosbags_numbers,
    rosbags_tf_message,
)
from helpers.processes import until
from xxhash import xxh3_128_intdigest

from zstate.net.session import Session
from zstate.net.streams import KeyPublisher

JOINT_STATES = (
    "joint_states",
    "sensor_msgs::msg::dds_::JointState_",
    "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "::,10:,:,:,,",
)
TF = (
    "tf",
    "tf2_msgs::msg::dds_::TFMessage_",
    "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "::,100:,:,:,,",
)
TF_STATIC = ("tf_static", TF[1], TF[2], ":1:,1:,:,:,,")
DESCRIPTION = (
    "robot_description",
    "std_msgs::msg::dds_::String_",
    "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    ":1:,1:,:,:,,",
)
COMMANDS = (
    "forward_position_controller/commands",
    "std_msgs::msg::dds_::Float64MultiArray_",
    "RIHS01_1025ddc6b9552d191f89ef1a8d2f60f3d373e28b283d8891ddcc974e8c55397f",
    "::,10:,:,:,,",
)
TRAJECTORY = (
    "forward_position_controller/joint_trajectory",
    "trajectory_msgs::msg::dds_::JointTrajectory_",
    STORE.hash_rihs01("trajectory_msgs/msg/JointTrajectory"),
    "::,10:,:,:,,",
)
TOPICS = (JOINT_STATES, TF, TF_STATIC, DESCRIPTION)
HUMBLE = "TypeHashNotSupported"

Topic = tuple[str, str, str, str]
_NUMBERS = count(1000)


def key_of(topic: Topic, namespace: str = "", domain: int = 0, written: str = "") -> str:
    """The data key: domain, name, type, hash."""
    name, dds, written_hash, _ = topic
    return f"{domain}/{namespace + '/' if namespace else ''}{name}/{dds}/{written or written_hash}"


def gid_of(token: str) -> bytes:
    """XXH3 of 128 bits, its low half first, each half little-endian."""
    return xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


def attachment(seq: int, gid: bytes, source_time: int = 1) -> bytes:
    return struct.pack("<qqB16s", seq, source_time, 16, gid)


def _transient_local() -> dict[str, Any]:
    return {
        "cache": zenoh.ext.CacheConfig(1),
        "publisher_detection": True,
        "sample_miss_detection": zenoh.ext.MissDetectionConfig(sporadic_heartbeat=0.5),
    }


# Keeps publishers alive: a collected publisher would withdraw its latched value.
_OPEN_PUBLISHERS: list[RosPublisher] = []


class RosPublisher:
    """One topic of one node; ``announce`` is separate and may follow the first messages."""

    def __init__(self, session: Session, topic: Topic, key: str, token: str, *, latched: bool) -> None:
        self.key, self.token, self.gid, self.seq = key, token, gid_of(token), 0
        self._session = session
        self._alive: zenoh.LivelinessToken | None = None
        self.publisher = zenoh.ext.declare_advanced_publisher(
            session.zenoh, key, **(_transient_local() if latched else {})
        )
        _OPEN_PUBLISHERS.append(self)

    def announce(self) -> RosPublisher:
        self._alive = self._session.zenoh.liveliness().declare_token(self.token)
        return self

    def wait_for_reader(self) -> RosPublisher:
        with KeyPublisher(self._session, self.key, "") as probe:
            until(lambda: probe.has_readers)
        return self

    def put(self, payload: bytes, extra: bytes | str | None = "next") -> None:
        """Publishes ``payload`` with the next attachment, or with the attachment ``extra``."""
        if extra == "next":
            self.seq += 1
            extra = attachment(self.seq, self.gid, now())
        self.publisher.put(payload, attachment=extra)

    def joints(self, stamp: int, names: Sequence[str], *blocks: Sequence[float]) -> None:
        self.put(rosbags_joint_state(stamp, "", names, *blocks, *[()] * (3 - len(blocks))))

    def transforms(self, stamp: int, edges: Edges, poses: Sequence[Sequence[float]]) -> None:
        self.put(rosbags_tf_message([stamp] * len(edges), edges, poses))

    def edge(self, stamp: int, parent: str, child: str, x: float) -> None:
        self.transforms(stamp, [(parent, child)], [moved(x)])

    def numbers(self, numbers: Sequence[float]) -> None:
        self.put(rosbags_numbers(numbers))

    def text(self, text: str) -> None:
        self.put(rosbags_cdr("std_msgs/msg/String", text))

    def close(self) -> None:
        """Undeclares token and publisher, as a node does at its end."""
        if self._alive is not None:
            self._alive.undeclare()
        self.publisher.undeclare()
        _OPEN_PUBLISHERS.remove(self)


class RosNode:
    """A node with publishers on any number of topics."""

    def __init__(self, session: Session, name: str, namespace: str = "/", domain: int = 0) -> None:
        self._session, self._domain = session, domain
        self._name, self._namespace = name, namespace
        self._nid = next(_NUMBERS)

    def publisher(self, topic: Topic, written: str = "", namespace: str = "") -> RosPublisher:
        """On ``topic``, in ``namespace`` without outer slashes; ``written`` replaces the type hash."""
        name, dds, its_hash, qos = topic
        path = f"/{namespace}/{name}".replace("//", "/").replace("/", "%")
        token = (
            f"@ros2_lv/{self._domain}/{self._session.zid}/{self._nid}/{next(_NUMBERS)}/MP/%/"
            f"{self._namespace.replace('/', '%')}/{self._name}/{path}/{dds}/{written or its_hash}/{qos}"
        )
        key = key_of(topic, namespace, self._domain, written)
        return RosPublisher(self._session, topic, key, token, latched=topic in (TF_STATIC, DESCRIPTION))


@contextmanager
def announced_publisher(session: Session, name: str, topic: Topic) -> Iterator[RosPublisher]:
    """A publisher of the node ``name``, which has discovered its reader, until it closes."""
    publisher = RosNode(session, name).publisher(topic).announce().wait_for_reader()
    yield publisher
    publisher.close()


class KeySubscriber:
    """The samples of one key, subscribed as a ROS node does."""

    def __init__(self, session: Session, key: str, *, latched: bool = False) -> None:
        self.samples: list[zenoh.Sample] = []
        if latched:
            self._subscriber = zenoh.ext.declare_advanced_subscriber(
                session.zenoh,
                key,
                self.samples.append,
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
                recovery=zenoh.ext.RecoveryConfig(heartbeat=True),
                subscriber_detection=True,
            )
        else:
            self._subscriber = session.zenoh.declare_subscriber(key, self.samples.append)

    def wait_for(self, number: int) -> list[zenoh.Sample]:
        until(lambda: len(self.samples) >= number)
        return list(self.samples)

    def messages(self, number: int, name: str) -> list:
        return [STORE.deserialize_cdr(sample.payload.to_bytes(), name) for sample in self.wait_for(number)]

    def attachments(self, number: int) -> list[tuple[int, int, bytes]]:
        """Sequence number, source time and gid of each."""
        return [read_attachment(sample) for sample in self.wait_for(number)]


def read_attachment(sample: zenoh.Sample) -> tuple[int, int, bytes]:
    assert sample.attachment is not None
    data = sample.attachment.to_bytes()
    assert len(data) == 33
    seq, source_time, length, gid = struct.unpack("<qqB16s", data)
    assert length == 16
    return seq, source_time, gid


def tokens(session: Session, domain: int = 0) -> list[str]:
    """The keys of all live tokens of a domain."""
    replies = session.zenoh.liveliness().get(f"@ros2_lv/{domain}/**", timeout=5.0)
    return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)


def moved(x: float) -> tuple[float, ...]:
    """A pose at ``x`` along the parent's x axis."""
    return (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def now() -> int:
    return time.time_ns()
