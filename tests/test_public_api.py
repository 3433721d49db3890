"""The public surface, pinned: a change here is a change for every user, and belongs in CHANGELOG.md."""

import inspect
import re
import subprocess
import sys
from collections.abc import Callable
from importlib import metadata, resources
from pkgutil import resolve_name
from types import FunctionType

import pytest
from helpers.processes import DEADLINE_S
from helpers.recording_builder import START, RecordingBuilder, S, swing_positions
from helpers.robots import wait_for_stream_readers

import zstate
from zstate import driving, odometry, scans, sources

SIGNATURES = {
    "load_model": "(source, *, xacro_args=None)",
    "connect": ("(config=None, *, mode=None, endpoints=(), listen=(), timeout_s=5.0, credentials=None)"),
    "discover": "(session, timeout_s=1.0, *, wire='native')",
    "Kinematics": "(model)",
    "Kinematics.edge_poses": "(positions, out=None)",
    "Kinematics.link_poses": "(positions, out=None)",
    "Kinematics.twist": "(link, positions, velocities, reference=None)",
    "JointReading": "(positions, velocities=None, efforts=None, stamp=None, oldest_stamp=None)",
    "SimulatedClock": "(session, wire='native', *, timeout_s=5.0)",
    "SimulatedClock.now": "()",
    "SimulatedClock.wait": "(timeout_s=None)",
    "SimulatedClock.close": "()",
    "ClockPublisher": "(session, wires=('native',))",
    "ClockPublisher.publish": "(stamp)",
    "ClockPublisher.close": "()",
    "SineSource": "(model, period_s=6.0)",
    "SineSource.read": "(stamp)",
    "StatePublisher": (
        "(session, model, robot=None, wires=('native',), *, "
        "streams=('joint_states', 'tf', 'tf_static', 'robot_description'), clock=None, program='', "
        "takeover=False, cache_s=2.0, pinocchio_on_demand=False)"
    ),
    "StatePublisher.publish": "(positions, velocities=None, efforts=None, stamp=None)",
    "StatePublisher.run": "(source, rate_hz=100.0, *, seconds=None)",
    "StatePublisher.close": "()",
    "StaticPublisher": "(session, robot, writer=None, wires=('native',), *, program='', takeover=False)",
    "StaticPublisher.set": "(transform)",
    "StaticPublisher.withdraw": "(child)",
    "StaticPublisher.close": "()",
    "PartialStatePublisher": (
        "(session, model, joints, robot=None, wires=('native',), *, writer=None, clock=None, program='', "
        "cache_s=2.0)"
    ),
    "PartialStatePublisher.publish": "(positions, velocities=None, efforts=None, stamp=None)",
    "PartialStatePublisher.run": "(source, rate_hz=100.0, *, seconds=None)",
    "PartialStatePublisher.close": "()",
    "TransformPublisher": (
        "(session, robot, writer=None, wires=('native',), *, clock=None, program='', cache_s=2.0)"
    ),
    "TransformPublisher.publish": "(transforms, stamp=None)",
    "TransformPublisher.run": "(source, rate_hz=50.0, *, seconds=None)",
    "TransformPublisher.close": "()",
    "StreamPublisher": "(session, robot, stream, name='', wires=('native',), *, clock=None, program='')",
    "StreamPublisher.publish": "(stamp=None, **fields)",
    "StreamPublisher.close": "()",
    "StreamListener": "(session, robot, stream, *, wire='native')",
    "StreamListener.get": "(timeout_s=None)",
    "StreamListener.close": "()",
    "JointStateListener": (
        "(session, robot, model=None, *, wire='native', stream='joint_states', on_reading=None, "
        "max_age_s=0.5)"
    ),
    "JointStateListener.read": "(stamp)",
    "JointStateListener.close": "()",
    "Transform": "(target, source, translation, rotation, stamp=None, *, kind=None)",
    "Transform.__matmul__": "(other)",
    "Transform.inverse": "()",
    "Transform.apply": "(points)",
    "Transform.from_matrix": "(target, source, matrix, stamp=None)",
    "Transform.from_pose7": "(target, source, pose7, stamp=None)",
    "Transform.from_se3": "(target, source, placement, stamp=None)",
    "Transform.from_rpy": "(target, source, translation, rpy, stamp=None)",
    "TransformBuffer": "(history_s=10.0, clock=None)",
    "TransformBuffer.interpolation_bound": "(target, source, at=None)",
    "TransformBuffer.add_robot": "(model, prefix='')",
    "TransformBuffer.remove_robot": "(track)",
    "TransformBuffer.insert_joints": "(track, stamp, positions, velocities=None)",
    "TransformBuffer.insert": "(transform, *, writer=None)",
    "TransformBuffer.insert_many": "(edges, stamp, poses, *, covariances=None, writer=None)",
    "TransformBuffer.insert_static": "(transform, *, writer=None)",
    "TransformBuffer.withdraw": "(child)",
    "TransformBuffer.clear": "()",
    "TransformBuffer.keep_only_around": "(stamps)",
    "TransformBuffer.stop": "(reason)",
    "TransformBuffer.lookup": ("(target, source, at=None, *, timeout_s=0.0, max_age_s=None, predict_s=0.0)"),
    "TransformBuffer.lookup_between": "(target, target_at, source, source_at, fixed)",
    "TransformBuffer.lookup_many": "(target, source, stamps)",
    "TransformBuffer.place": "(points, stamps, source, target)",
    "TransformBuffer.project": "(points, frame, camera, stamp)",
    "TransformBuffer.plan": "(target, source)",
    "TransformBuffer.twist": "(frame, reference, at=None)",
    "TransformBuffer.can_lookup": "(target, source, at=None)",
    "TransformBuffer.explain": "(target, source, at=None)",
    "TransformBuffer.latest": "(target, source)",
    "TransformBuffer.wait": "(target, source, at=None, timeout_s=1.0)",
    "TransformBuffer.wait_async": "(target, source, at=None, timeout_s=1.0)",
    "TransformBuffer.watch": "(target, source, callback, *, translation_m=None, rotation_rad=None)",
    "TransformBuffer.join": (
        "(samples, target, *, frame=operator.attrgetter('frame'), stamp=operator.attrgetter('stamp'), "
        "timeout_s=1.0)"
    ),
    "TransformBuffer.frames": "(among=None)",
    "TransformBuffer.path_frames": "(target, source)",
    "TransformBuffer.frame_table": "(robots=())",
    "TransformBuffer.snapshot": "(at=None, *, robots=(), hold_s=0.0)",
    "TransformBuffer.span": "()",
    "TransformBuffer.joint_positions": "(robot, at=None)",
    "TransformBuffer.joint_positions_many": "(robot, stamps)",
    "TransformBuffer.joint_states": "(robot, start=None, end=None)",
    "TransformBuffer.link_poses": "(robot, at=None)",
    "Recorder": (
        "(session, path, robots=(), *, wire='native', max_bytes=None, max_seconds=None, overwrite=False)"
    ),
    "Recorder.wait": "(timeout_s=None)",
    "Recorder.close": "()",
    "Archive": "(url)",
    "Archive.robots": "()",
    "Archive.coverage": "(robot)",
    "Archive.buffer": "(robot, start, end)",
    "Archive.joint_states": "(robot, start, end)",
    "Archive.lookup_many": "(target, source, stamps, *, robot)",
    "Archive.messages": "(robot, stream, start, end)",
    "Archive.duckdb": "()",
    "Recording": "(path, robot=None)",
    "Recording.buffer": "(around=None)",
    "Recording.joint_states": "(robot=None)",
    "Recording.joint_state_reader": "(robot=None, refuse=None)",
    "Recording.lookup_many": "(target, source, stamps)",
    "Recording.place": "(points, stamps, source, target)",
    "Recording.close": "()",
    "TransformListener": (
        "(session, robot='*', buffer=None, wire='native', follow='joint_states', history_s=10.0, "
        "*, clock=None, history_on_join=True, on_event=None, placers=None)"
    ),
    "TransformListener.robots": "()",
    "TransformListener.events": "()",
    "TransformListener.close": "()",
}

ERRORS = {
    "ZStateError": Exception,
    "AccessDenied": zstate.ZStateError,
    "Closed": zstate.ZStateError,
    "InvalidInput": ValueError,
    "InsertRefused": zstate.InvalidInput,
    "RecordingError": zstate.ZStateError,
    "SecondWriter": zstate.ZStateError,
    "Unreachable": TimeoutError,
    "ModelError": ValueError,
    "LookupFailed": zstate.ZStateError,
    "AmbiguousFrame": zstate.LookupFailed,
    "ClockMismatch": zstate.LookupFailed,
    "Disconnected": zstate.LookupFailed,
    "InFuture": zstate.LookupFailed,
    "InPast": zstate.LookupFailed,
    "NoData": zstate.LookupFailed,
    "Stale": zstate.LookupFailed,
    "UnknownFrame": zstate.LookupFailed,
}


def named(path: str) -> object:
    found: object = zstate
    for name in path.split("."):
        found = getattr(found, name)
    return found


def signature_of(path: str) -> str:
    """Parameters with their kinds and defaults, without ``self`` and annotations."""
    given = inspect.signature(named(path))
    parameters = [
        parameter.replace(annotation=inspect.Parameter.empty)
        for parameter in given.parameters.values()
        if parameter.name != "self"
    ]
    return str(inspect.Signature(parameters))


DATA = {"RobotModel", "Twist", "kernel"}
"""Names that a program receives, and seldom or never constructs."""


def test_the_front_door_has_exactly_the_names_of_this_file():
    callables = {path for path in SIGNATURES if "." not in path}
    assert list(zstate.__all__) == sorted(callables | set(ERRORS) | DATA)


def test_every_name_is_listed_and_has_a_docstring():
    assert [name for name in zstate.__all__ if name not in dir(zstate)] == []
    assert [name for name in zstate.__all__ if not inspect.getdoc(getattr(zstate, name))] == []


def test_signatures_are_the_contract():
    assert {path: signature_of(path) for path in SIGNATURES} == SIGNATURES


def test_a_buffer_has_what_a_program_may_call_and_nothing_else():
    public = {name for name in dir(zstate.TransformBuffer()) if not name.startswith("_")}
    methods = {path.partition(".")[2] for path in SIGNATURES if path.startswith("TransformBuffer.")}
    assert public == methods | {"clock", "history_s", "ignored"}


@pytest.mark.parametrize(
    ("path", "name", "value"),
    [
        ("driving:DriverHost", "rate_hz", 100.0),
        ("driving:DriverHost", "ttl_s", 0.25),
        ("driving:DriverHost", "faults_allowed", 3),
        ("driving:DriverHost", "following_error", 0.2),
        ("driving:Commander.move", "path_tolerance", 0.2),
        ("driving:Commander.move", "goal_tolerance", 0.05),
        ("driving:Commander.move", "goal_time_s", 1.0),
        ("odometry:BaseEstimator", "history_s", 1.0),
        ("odometry:VelocityNoise", "scale", 0.02),
        ("scans:ScanListener", "timeout_s", 1.0),
    ],
)
def test_defaults_are_those_that_the_guides_name(path: str, name: str, value: float):
    assert inspect.signature(resolve_name(f"zstate.{path}")).parameters[name].default == value


def test_errors_derive_from_what_a_caller_would_catch():
    for name, base in ERRORS.items():
        assert issubclass(getattr(zstate, name), base), name
        assert issubclass(getattr(zstate, name), zstate.ZStateError), name


def test_a_model_has_its_documented_attributes():
    parts = ("name", "root", "links", "joints", "joint_names", "digest", "urdf", "findings")
    assert [part for part in parts if not hasattr(zstate.load_model("rrbot"), part)] == []


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="'zstate' has no attribute 'Publisher'"):
        zstate.Publisher  # noqa: B018


def test_every_error_is_reached_by_importing_the_package_alone():
    program = "import zstate; print(issubclass(zstate.errors.FrameMismatch, zstate.InvalidInput))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"


def test_values_cannot_be_changed():
    base_from_hand = zstate.Transform("base", "hand", [0, 0, 1], [0, 0, 0, 1])
    with pytest.raises(AttributeError):
        base_from_hand.target = "other"
    with pytest.raises(ValueError, match="read-only"):
        base_from_hand.translation[0] = 1.0
    assert base_from_hand.translation.tolist() == [0, 0, 1]


def test_a_repr_is_one_short_line_that_tells_one_object_from_another(sessions, tmp_path):
    model = zstate.load_model("rrbot")
    with (
        zstate.StatePublisher(sessions[0], model, "r1") as publisher,
        zstate.StaticPublisher(sessions[0], "r1", "mount") as statics,
        zstate.TransformListener(sessions[1], "r1") as listener,
    ):
        statics.set(zstate.Transform("tool", "camera", (0, 0, 1), (0, 0, 0, 1)))
        wait_for_stream_readers(sessions[0], "r1")
        publisher.publish([0.0, 0.0])
        listener.buffer.lookup("world", "camera", timeout_s=DEADLINE_S)
        watch = listener.buffer.watch("world", "camera", lambda transform: None)
        (robot,) = zstate.discover(sessions[1])
        shown = {
            publisher: "<StatePublisher of 'r1' on native: 1 samples>",
            statics: "<StaticPublisher 'mount' of 'r1': 1 edges>",
            listener: "<TransformListener of 'r1': 1 robots, 1 samples received>",
            listener.buffer: "<TransformBuffer: 8 frames of 'r1', 10 s of history>",
            watch: "<TransformWatch of 'camera' in 'world'>",
            listener.buffer.join(samples(), "world"): "<MessageFilter for 'world': 0 joined>",
            zstate.Kinematics(model): "<Kinematics of 'rrbot', 7 links>",
            model: "RobotModel('rrbot', 7 links, 2 driven joints)",
        }
        assert [repr(thing) for thing in shown] == list(shown.values())
        assert repr(robot).startswith("<robot 'r1': ")
        assert "writes joint_states, robot_description, tf, tf_static" in repr(robot)
        watch.close()
    assert repr(publisher) == "<StatePublisher of 'r1' on native: 1 samples, closed>"
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        builder.joints("arm", START + S, swing_positions(0), log_time=START + S)
    with zstate.Recording(tmp_path / "r.mcap") as recording:
        assert repr(recording) == f"<Recording '{tmp_path}/r.mcap': 1 s, robots 'arm'>"
        assert repr(recording.buffer()).endswith("frames of 'arm', of a recording>")


async def samples():
    """None."""
    for sample in ():
        yield sample


def test_the_version_is_that_of_the_package():
    assert zstate.__version__ == metadata.version("zstate")


def test_the_package_says_that_it_is_typed():
    assert (resources.files("zstate") / "py.typed").is_file()


METHODS = (FunctionType, classmethod, staticmethod)


def public_calls() -> dict[str, Callable[..., object]]:
    """All classes, methods and functions of the API by path, but errors: a program receives those."""
    found: dict[str, Callable[..., object]] = {}
    for module in (zstate, driving, odometry, scans, sources):
        for name in module.__all__:
            given = getattr(module, name)
            if not callable(given) or (isinstance(given, type) and issubclass(given, Exception)):
                continue
            found[f"{module.__name__}.{name}"] = given
            methods = dir(given) if isinstance(given, type) else ()
            found |= {
                f"{module.__name__}.{name}.{method}": getattr(given, method)
                for method in methods
                if method[0] != "_" and isinstance(inspect.getattr_static(given, method), METHODS)
            }
    return found


def test_each_parameter_of_a_call_with_more_than_three_is_described():
    checked = 0
    for path, call in public_calls().items():
        parameters = inspect.signature(call).parameters.keys() - {"self", "session"}
        text = inspect.getdoc(call) or ""
        if len(parameters) > 3:
            unnamed = [name for name in parameters if not re.search(rf"``[^`]*\b{name}\b[^`]*``", text)]
            assert unnamed == [], path
            checked += 1
    assert checked > 80
