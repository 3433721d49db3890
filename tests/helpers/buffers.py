"""Stamps, transforms, buffers, and a robot with every type of joint."""

from __future__ import annotations

import pytest

from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.tracks import JointTrack
from zstate.errors import LookupFailed
from zstate.model.load import load_model
from zstate.se3 import quaternion_from_rpy
from zstate.transform import Transform

MS = 1_000_000
S = 1_000_000_000
NOW = 1_790_000_000_123_456_789
"""A realistic stamp with digits that float seconds would lose."""


def turned(yaw: float) -> tuple[float, float, float, float]:
    """The quaternion of a yaw angle of any size."""
    return quaternion_from_rpy(0.0, 0.0, yaw)


def moving(parent: str, child: str, stamp: int, x: float = 0.0, yaw: float = 0.0) -> Transform:
    return Transform(parent, child, (x, 0.0, 0.0), turned(yaw), stamp)


def static(parent: str, child: str, x: float = 0.0, yaw: float = 0.0) -> Transform:
    return Transform(parent, child, (x, 0.0, 0.0), turned(yaw))


def x_of(transform: Transform) -> float:
    return float(transform.translation[0])


def filled(*transforms: Transform, history_s: float = 10.0) -> TransformBuffer:
    """A buffer with these transforms; transforms without a stamp are static."""
    buffer = TransformBuffer(history_s)
    for transform in transforms:
        if transform.stamp is None:
            buffer.insert_static(transform)
        else:
            buffer.insert(transform)
    return buffer


def failure(
    buffer: TransformBuffer, target: str, source: str, stamp: int | None = None, **options: float
) -> LookupFailed:
    """The error that a lookup raises; without options ``explain`` must return an equal one."""
    with pytest.raises(LookupFailed) as caught:
        buffer.lookup(target, source, stamp, **options)
    if not options:
        explained = buffer.explain(target, source, stamp)
        assert type(explained) is type(caught.value)
        assert str(explained) == str(caught.value)
        assert not buffer.can_lookup(target, source, stamp)
    return caught.value


EVERY_JOINT = """
<robot name="every">
  <link name="root"/><link name="body"/><link name="wheel"/><link name="arm"/><link name="follower"/>
  <link name="second"/><link name="lift"/><link name="sled"/><link name="tip"/>
  <joint name="free" type="floating">
    <parent link="root"/><child link="body"/><origin xyz="0 0 1" rpy="0 0 1.5707963267948966"/>
  </joint>
  <joint name="spin" type="continuous">
    <parent link="body"/><child link="wheel"/><axis xyz="0 0 1"/>
  </joint>
  <joint name="bend" type="revolute">
    <parent link="body"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit lower="-20" upper="20" velocity="9" effort="9"/>
  </joint>
  <joint name="follow" type="revolute">
    <parent link="arm"/><child link="follower"/><origin xyz="1 0 0"/><axis xyz="0 0 1"/>
    <limit lower="-50" upper="50" velocity="9" effort="9"/><mimic joint="bend" multiplier="2" offset="0.25"/>
  </joint>
  <joint name="follow_on" type="prismatic">
    <parent link="follower"/><child link="second"/><axis xyz="1 0 0"/>
    <limit lower="-50" upper="50" velocity="9" effort="9"/>
    <mimic joint="follow" multiplier="-3" offset="0.5"/>
  </joint>
  <joint name="raise" type="prismatic">
    <parent link="body"/><child link="lift"/><axis xyz="0 0 1"/>
    <limit lower="-5" upper="5" velocity="9" effort="9"/>
  </joint>
  <joint name="slide" type="planar">
    <parent link="lift"/><child link="sled"/><origin xyz="0 1 0"/><axis xyz="0 0 1"/>
  </joint>
  <joint name="end" type="fixed">
    <parent link="sled"/><child link="tip"/><origin xyz="0.5 0 0"/>
  </joint>
</robot>
"""


def every_joint() -> tuple[TransformBuffer, JointTrack]:
    """A buffer with a robot that has one joint of each type."""
    buffer = TransformBuffer()
    return buffer, buffer.add_robot(load_model(EVERY_JOINT))


def pose_of_every(
    track: JointTrack,
    *,
    free: tuple[float, ...] = (0, 0, 0, 0, 0, 0, 1),
    spin: float = 0.0,
    bend: float = 0.0,
    lift: float = 0.0,
    slide: tuple[float, ...] = (0, 0, 0),
):
    """The positions of that robot, given by joint."""
    values = {"free": free, "spin": spin, "bend": bend, "raise": lift, "slide": slide}
    return track.model.positions(values)
