"""Readers, collected samples, and independently derived poses for tests of publishers and listeners."""

from __future__ import annotations

import numpy as np
import zenoh
from helpers.processes import until
from numpy.typing import ArrayLike, NDArray

from zstate.model.kinematics import Kinematics
from zstate.model.load import load_model
from zstate.model.robot import RobotModel
from zstate.net.session import Session
from zstate.net.streams import KeyPublisher, StreamSubscriber
from zstate.se3 import to_matrix
from zstate.transform import Transform
from zstate.wire.messages import JointState
from zstate.wire.native import decode, encoding_of
from zstate.wire.protocol import SerializedSample

RRBOT = load_model("rrbot")
"""World, base, two links on continuous joints (shoulder, elbow), and a tool."""

SECOND = 1_000_000_000
STAMP = 1_789_012_345_678_901_234
UPRIGHT = (0.0, 0.0, 0.0, 1.0)


def wait_for_reader(session: Session, key: str) -> None:
    """Waits until ``session`` has discovered a subscriber of ``key``, which receives all later samples."""
    with KeyPublisher(session, key, "") as probe:
        until(lambda: probe.has_readers)


def wait_for_stream_readers(session: Session, robot: str, *streams: str) -> None:
    """Waits until ``streams`` of ``robot`` have readers; default: joint states."""
    for stream in streams or ("joint_states",):
        wait_for_reader(session, f"zstate/{robot}/{stream}")


def put(
    session: Session, key: str, payload: bytes, encoding: str = "", attachment: bytes | None = None
) -> None:
    """Puts a payload that is not dropped on the way, as those on a busy link are otherwise."""
    blocking = zenoh.CongestionControl.BLOCK
    session.zenoh.put(
        key, payload, encoding=encoding or None, attachment=attachment, congestion_control=blocking
    )


class SampleCollector:
    """Collects all samples of one key."""

    def __init__(self, session: Session, key: str) -> None:
        self.arrivals: list[SerializedSample] = []
        self._subscriber = StreamSubscriber(session, key, self.arrivals.extend)

    def payloads(self, count: int) -> list[bytes]:
        """The first ``count`` payloads, after waiting for them."""
        until(lambda: len(self.arrivals) >= count)
        return [arrival.payload for arrival in self.arrivals]

    def joint_states(self, count: int) -> list[JointState]:
        """The first ``count`` payloads, as joint states."""
        return [decode(payload, encoding_of(JointState), JointState) for payload in self.payloads(count)]

    def close(self) -> None:
        self._subscriber.close()


def kinematic_pose(model: RobotModel, positions: ArrayLike, target: str, source: str) -> NDArray[np.float64]:
    """``target_from_source`` as a matrix, from poses in the root."""
    poses = dict(zip(model.links, Kinematics(model).link_poses(positions), strict=True))
    root_from_target, root_from_source = (to_matrix(tuple(poses[link])) for link in (target, source))
    return np.linalg.solve(root_from_target, root_from_source)


def assert_pose(transform: Transform, matrix: ArrayLike) -> None:
    assert np.allclose(transform.matrix, matrix, rtol=0.0, atol=1e-12), transform
