"""Sources of joint states: test signals and other publishers."""

from zstate.sources.joint_source import JointReading, JointSource, SineSource
from zstate.sources.joint_state_listener import JointStateListener

__all__ = ["JointReading", "JointSource", "JointStateListener", "SineSource"]
