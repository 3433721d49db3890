"""Sources of joint states: test signals and other publishers."""

from zstate.sources.joint_source import JointReading, JointSource
from zstate.sources.joint_state_listener import JointStateListener
from zstate.sources.sine import SineSource

__all__ = ["JointReading", "JointSource", "JointStateListener", "SineSource"]
