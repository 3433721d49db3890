"""Sources of joint states: test signals and other publishers."""

from zstate.sources.joint_source import JointReading, JointSource, SineSource
from zstate.sources.subscribed import SubscribedSource

__all__ = ["JointReading", "JointSource", "SineSource", "SubscribedSource"]
