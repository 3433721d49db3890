"""Sources of joint states and transforms: test signals and other publishers."""

from zstate.sources.joint_source import JointReading, JointSource, SineSource
from zstate.sources.joint_state_listener import JointStateListener
from zstate.sources.square_drive import OdometrySource, SquareDrive, WheelPair, WheelSource

__all__ = [
    "JointReading",
    "JointSource",
    "JointStateListener",
    "OdometrySource",
    "SineSource",
    "SquareDrive",
    "WheelPair",
    "WheelSource",
]
