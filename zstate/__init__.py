"""Robot state over Zenoh: joint states, transforms, and a time-indexed transform buffer.

``lookup("a", "b")`` is ``a_from_b``: the pose of frame b in frame a, which also maps coordinates in b
into a. Quaternions are x y z w, units are SI, stamps are integer nanoseconds since the Unix epoch.

Names are loaded at their first use: a program that only reads transforms loads no kinematics.
``zstate.errors`` has every exception; the most common ones are also here.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from zstate import errors as errors
    from zstate.archive.archive import Archive
    from zstate.buffer.buffer import TransformBuffer
    from zstate.errors import (
        AccessDenied,
        AmbiguousFrame,
        ClockMismatch,
        Closed,
        Disconnected,
        InFuture,
        InPast,
        InsertRefused,
        InvalidInput,
        LookupFailed,
        ModelError,
        NoData,
        SecondWriter,
        Stale,
        UnknownFrame,
        Unreachable,
        ZStateError,
    )
    from zstate.extension import kernel
    from zstate.model.kinematics import Kinematics
    from zstate.model.load import load_model
    from zstate.model.robot import RobotModel
    from zstate.net.discovery import discover
    from zstate.net.session import connect
    from zstate.nodes.clock import ClockPublisher, SimulatedClock
    from zstate.nodes.listener import TransformListener
    from zstate.nodes.partial_publisher import PartialStatePublisher
    from zstate.nodes.publisher import StatePublisher
    from zstate.nodes.static_publisher import StaticPublisher
    from zstate.nodes.stream_listener import StreamListener
    from zstate.nodes.stream_publisher import StreamPublisher
    from zstate.nodes.transform_publisher import TransformPublisher
    from zstate.recording.errors import RecordingError
    from zstate.recording.recorder import Recorder
    from zstate.recording.recording import Recording
    from zstate.sources import JointReading, JointStateListener, SineSource
    from zstate.transform import Transform, Twist

__version__ = "0.1.0"

__all__ = [
    "AccessDenied",
    "AmbiguousFrame",
    "Archive",
    "ClockMismatch",
    "ClockPublisher",
    "Closed",
    "Disconnected",
    "InFuture",
    "InPast",
    "InsertRefused",
    "InvalidInput",
    "JointReading",
    "JointStateListener",
    "Kinematics",
    "LookupFailed",
    "ModelError",
    "NoData",
    "PartialStatePublisher",
    "Recorder",
    "Recording",
    "RecordingError",
    "RobotModel",
    "SecondWriter",
    "SimulatedClock",
    "SineSource",
    "Stale",
    "StatePublisher",
    "StaticPublisher",
    "StreamListener",
    "StreamPublisher",
    "Transform",
    "TransformBuffer",
    "TransformListener",
    "TransformPublisher",
    "Twist",
    "UnknownFrame",
    "Unreachable",
    "ZStateError",
    "connect",
    "discover",
    "kernel",
    "load_model",
]

_HOMES = {
    "Archive": "archive.archive",
    "ClockPublisher": "nodes.clock",
    "JointReading": "sources",
    "JointStateListener": "sources",
    "Kinematics": "model.kinematics",
    "PartialStatePublisher": "nodes.partial_publisher",
    "Recorder": "recording.recorder",
    "Recording": "recording.recording",
    "RecordingError": "recording.errors",
    "RobotModel": "model.robot",
    "SimulatedClock": "nodes.clock",
    "SineSource": "sources",
    "StatePublisher": "nodes.publisher",
    "StaticPublisher": "nodes.static_publisher",
    "StreamListener": "nodes.stream_listener",
    "StreamPublisher": "nodes.stream_publisher",
    "Transform": "transform",
    "TransformBuffer": "buffer.buffer",
    "TransformListener": "nodes.listener",
    "TransformPublisher": "nodes.transform_publisher",
    "Twist": "transform",
    "connect": "net.session",
    "discover": "net.discovery",
    "kernel": "extension",
    "load_model": "model.load",
}


if not TYPE_CHECKING:  # type checkers would take any name for one of the package

    def __getattr__(name: str) -> object:
        if name == "errors":
            return import_module("zstate.errors")
        if name not in __all__:
            from pathlib import Path  # noqa: PLC0415 - as below

            folder = Path(__file__).parent
            if name.startswith("_") or (folder / f"{name}.py").exists():
                # ``from zstate import se3`` looks for this attribute, and then imports the module.
                raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
            from zstate._util.other_names import missing_name  # noqa: PLC0415 - for mistakes alone

            raise missing_name(__name__, folder, name)
        value: object = getattr(import_module(f"{__name__}.{_HOMES.get(name, 'errors')}"), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
