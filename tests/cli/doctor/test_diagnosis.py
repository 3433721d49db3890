from __future__ import annotations

import json
import os
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from helpers.cli_runner import ALL_STREAMS, RRBOT, Spawn, failure, published_robot, run_cli, started
from helpers.processes import DEADLINE_S, find_free_port, repeated, until
from helpers.programs import router

from zstate import PartialStatePublisher, StatePublisher, StaticPublisher, Transform, connect, load_model
from zstate.cli.doctor.robot_probe import RobotProbe, StreamCollector
from zstate.clock import ManualClock, SystemClock
from zstate.driving import Commander, stop
from zstate.net.discovery import discover, discover_readers
from zstate.net.presence import announce, local_writer
from zstate.net.security.credentials import Credentials
from zstate.nodes.clock import ClockPublisher
from zstate.nodes.listener import TransformListener
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.odometry import ImuPublisher, OdometryPublisher, SensorListener
from zstate.sources import JointStateListener
from zstate.streams import StreamName
from zstate.wire.identity import WriterId
from zstate.wire.keys import READER_TOKEN, WRITER_TOKEN
from zstate.wire.messages import JointState, order_digest
from zstate.wire.native import encode, encoding_of

SECOND = 1_000_000_000
LINKS = ["zstate", "network", "robots", "writers", "model", "joint_states", "clocks", "stamps"]


def diagnosed(*arguments: str, code: int) -> dict[str, Any]:
    """The JSON output of doctor."""
    ended = run_cli("doctor", *arguments, "--json", "--timeout", "2")
    assert ended.code == code, (ended.stdout, ended.stderr)
    assert ended.stderr == ""
    return json.loads(ended.stdout)


def broken_link(*arguments: str) -> dict[str, str]:
    """The first broken link."""
    report = diagnosed(*arguments, code=1)
    assert not report["sound"]
    return report["first_broken"]


def warnings(*arguments: str) -> dict[str, str]:
    """The texts of warnings by link, if no link is broken."""
    checks = diagnosed(*arguments, code=0)["checks"]
    return {check["name"]: check["text"] for check in checks if check["state"] == "warning"}


@contextmanager
def published_with_stamps(
    stamp: Callable[[], int], streams: tuple[StreamName, ...] = ALL_STREAMS
) -> Iterator[None]:
    """Publishes rrbot a hundred times a second, with the stamps that ``stamp`` returns."""
    with (
        connect() as session,
        StatePublisher(session, load_model(RRBOT), streams=streams) as publisher,
        repeated(lambda: publisher.publish([0.0, 0.0], stamp=stamp())),
    ):
        yield


def test_every_link_of_a_working_robot_is_ok(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ZSTATE_KERNEL", "reference")  # selected by the user: no warning
    with published_robot():
        report = diagnosed("rrbot", code=0)
        text = run_cli("doctor", "rrbot").stdout
    assert report["sound"]
    assert report["first_broken"] is None
    assert [check["name"] for check in report["checks"]] == [*LINKS, "tf_static", "poses"]
    assert {check["state"] for check in report["checks"]} == {"ok"}, report
    assert text.endswith("all is sound\n")
    assert "\x1b" not in text


def test_working_robots_among_several_take_one_line():
    with published_robot("left"), published_robot("right", streams=("tf_static", "robot_description")):
        lines = run_cli("doctor").stdout.splitlines()
    (left,) = [line for line in lines if "left" in line and "announced" not in line]
    assert left.split()[:2] == ["ok", "left"]
    assert lines[-2] == "first broken link: joint_states of 'right'"
    assert lines[-1].startswith("next: zstate joints FILE --name right")


@pytest.mark.robots
def test_without_robots_the_next_command_starts_one():
    found = broken_link()
    assert (found["name"], found["next"]) == ("robots", "zstate publish panda --source sine")
    assert "no robot is announced" in found["text"]


def test_missing_robot_is_reported_with_the_announced_ones():
    with published_robot():
        found = broken_link("rbot")
    assert found["text"] == "robot 'rbot' is not announced; announced: 'rrbot'"
    assert found["next"] == "zstate doctor rrbot"


def test_robots_that_an_option_hides_are_found(free_port: int):
    with router(f"tcp/127.0.0.1:{free_port}") as endpoint, published_robot():
        found = broken_link("--connect", endpoint)
    assert "'rrbot'" in found["text"]
    assert found["next"] == "zstate doctor rrbot"


@pytest.mark.usefixtures("impatient")
def test_robots_of_this_host_are_found_when_the_router_is_missing(free_port: int):
    with published_robot():
        found = broken_link("--connect", f"tcp/127.0.0.1:{free_port}")
    assert found["name"] == "network"
    assert "without --connect, among the programs of this host: 'rrbot'" in found["text"]


def test_a_robot_without_its_driver_lacks_joint_states():
    with connect() as session, StatePublisher(session, load_model(RRBOT), streams=ALL_STREAMS[1:]):
        found = broken_link("rrbot")
    assert (found["name"], found["robot"]) == ("joint_states", "rrbot")
    assert found["text"].startswith("'rrbot' has no writer of joint_states, which ")
    assert "its driver is not running" in found["text"]


def test_driver_with_another_robot_name_is_found():
    with (
        published_robot("rrbot1", streams=("joint_states",)),
        connect() as session,
        StatePublisher(session, load_model(RRBOT), streams=ALL_STREAMS[1:]),
    ):
        found = broken_link("rrbot")
    assert "'rrbot1', which has joint_states but no model" in found["text"]
    assert found["next"] == "zstate publish FILE --name rrbot1"


def test_joint_states_without_a_model_lack_the_model():
    with published_robot(streams=("joint_states",)):
        found = broken_link("rrbot")
    assert (found["name"], found["next"]) == ("model", "zstate publish rrbot")


def test_joints_of_another_model_are_refused_with_the_reason(tmp_path: Path):
    other = tmp_path / "other.urdf"
    other.write_text(Path(RRBOT).read_text().replace('"elbow"', '"knee"'))
    with (
        published_robot(streams=("joint_states",), model=str(other)),
        connect() as session,
        StatePublisher(session, load_model(RRBOT), streams=ALL_STREAMS[1:]),
    ):
        found = broken_link("rrbot")
    assert found["name"] == "joint_states"
    assert "do both sides use the same URDF?" in found["text"]


@pytest.mark.processes
def test_stopped_writer_is_distinguished_from_a_closed_one(spawn: Spawn, free_port: int):
    with router(f"tcp/127.0.0.1:{free_port}") as endpoint:
        child = started(spawn, "publish", RRBOT, "--source", "sine", "--connect", endpoint)
        child.line()
        assert run_cli("wait", "robot", "rrbot", "--connect", endpoint).code == 0
        child.freeze()
        found = broken_link("rrbot", "--connect", endpoint)
    assert found["name"] == "writers"
    assert "stopped" in found["text"]
    assert str(child.process.pid) in found["next"]


def test_silent_writer_of_transforms_is_named_and_the_rest_is_sound():
    edge = [Transform("odom", "world", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))]
    with (
        published_robot(),
        connect() as session,
        TransformPublisher(session, "rrbot", "odometry") as odometry,
        TransformPublisher(session, "rrbot", "camera"),
        repeated(lambda: odometry.publish(edge)),
    ):
        found = warnings("rrbot")
    assert list(found) == ["transforms"]
    assert "as 'camera', is announced, but no sample arrives" in found["transforms"]


def test_joint_without_a_driver_is_named():
    model = load_model(RRBOT)
    with (
        connect() as session,
        StatePublisher(session, model, "rrbot", streams=("robot_description", "tf_static")),
        PartialStatePublisher(session, model, ["elbow"], "rrbot") as gripper,
        repeated(lambda: gripper.publish([0.0])),
    ):
        found = broken_link("rrbot")
    assert found["name"] == "partial_joint_states"
    assert found["text"].startswith("'shoulder' of 'rrbot' without a writer")
    assert found["next"].startswith("zstate joints rrbot --only shoulder")


def test_stamps_of_one_of_several_drivers_are_reported():
    model = load_model(RRBOT)
    with (
        connect() as session,
        StatePublisher(session, model, "rrbot", streams=("robot_description", "tf_static")),
        PartialStatePublisher(session, model, ["shoulder"], "rrbot", program="arm.py") as arm,
        PartialStatePublisher(session, model, ["elbow"], "rrbot", program="gripper.py") as gripper,
        repeated(lambda: arm.publish([0.0])),
        repeated(lambda: gripper.publish([0.0], stamp=time.time_ns() + 5 * SECOND)),
    ):
        found = broken_link("rrbot")
    assert found["name"] == "stamps"
    assert found["text"].startswith("gripper.py@")
    assert "in the future" in found["text"]


def test_robot_with_odometry_and_an_imu_is_sound_if_the_frame_of_the_imu_is_placed():
    base = Transform("odom", "base", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    with (
        connect() as session,
        OdometryPublisher(session, "cart", "wheels") as odometry,
        ImuPublisher(session, "cart", "chest", frame="base_imu") as imu,
        repeated(lambda: odometry.publish(base, [0, 0, 0], [0, 0, 0])),
        repeated(lambda: imu.publish([0, 0, 0], [0, 0, 9.81])),
    ):
        found = broken_link("cart")
        assert "the imu of 'chest' is in 'cart/base_imu', which no writer places" in found["text"]
        with StaticPublisher(session, "cart", "mount") as statics:
            statics.set(Transform("base", "base_imu", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0)))
            report = diagnosed("cart", code=0)
    texts = {check["name"]: check["text"] for check in report["checks"]}
    assert report["sound"]
    assert re.search(r"Hz from .* as 'wheels'", texts["odometry"])
    assert re.search(r"Hz from .* as 'chest'", texts["imu"])
    assert re.fullmatch(r"3 frames in one tree; cart/base(_imu)? in cart/odom is known", texts["poses"])


def test_robot_with_transforms_only_is_sound():
    edge = [Transform("odom", "base", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))]
    with (
        connect() as session,
        TransformPublisher(session, "cart", "odometry") as odometry,
        repeated(lambda: odometry.publish(edge)),
    ):
        report = diagnosed("cart", code=0)
    found = {check["name"]: check["text"] for check in report["checks"]}
    assert report["sound"]
    assert "as 'odometry'" in found["transforms"]
    assert found["stamps"].endswith("old on arrival")
    assert found["poses"].endswith("cart/base in cart/odom is known")


def test_odometry_whose_driver_has_ended_names_the_streams_that_it_waits_for():
    edge = Transform("odom", "base", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    with (
        connect() as session,
        OdometryPublisher(session, "cart", "odometry", program="odometry") as odometry,
        TransformListener(session, "cart"),
        SensorListener(session, "cart", {"imu": lambda *_: None}),
        JointStateListener(session, "cart"),
        repeated(lambda: odometry.publish(edge, [0, 0, 0], [0, 0, 0])),
    ):
        report = diagnosed("cart", code=1)
    first, states = report["first_broken"], {check["name"]: check["state"] for check in report["checks"]}
    assert first["name"] == "programs"
    assert (
        f"pid {os.getpid()} waits for imu and joint_states of 'cart', which have no writer" in first["text"]
    )
    assert (states["model"], states["joint_states"]) == ("broken", "broken")
    assert first["next"].startswith("zstate ls  # start ")


def test_readers_of_other_programs_wait_for_nothing_that_a_robot_lacks():
    """Such as `zstate echo` of a stream that the robot does not have."""
    edge = Transform("odom", "base", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    with (
        connect() as session,
        OdometryPublisher(session, "cart", "odometry") as odometry,
        TransformListener(session, "cart"),
        connect() as other,
        announce(other, READER_TOKEN.key("cart", "imu", WriterId("zstate-echo", "desk", 9, 1, 7).identity)),
        repeated(lambda: odometry.publish(edge, [0, 0, 0], [0, 0, 0])),
    ):
        until(lambda: any(one.stream == "imu" for one in discover_readers(session)))
        assert diagnosed("cart", code=0)["sound"]


def test_a_fifth_of_lost_samples_is_a_warning():
    """Three of four sequence numbers arrive: 75 % of what was sent."""
    seq = count()
    order = order_digest(load_model(RRBOT).joint_names)
    writer = local_writer(7, "lossy")
    with (
        connect() as session,
        StatePublisher(session, load_model(RRBOT), streams=ALL_STREAMS[1:]),
        announce(session, WRITER_TOKEN.key("rrbot", "joint_states", writer.identity)),
    ):

        def publish() -> None:
            number = next(seq)
            if number % 4:
                state = JointState(time.time_ns(), number, 7, order, bytes(16))
                session.zenoh.put(
                    "zstate/rrbot/joint_states", encode(state), encoding=encoding_of(JointState)
                )

        with repeated(publish):
            found = warnings("rrbot")
    assert re.search(r"Hz from lossy@.*; \d+ were lost on the way and 0 here", found["joint_states"])


def test_a_writer_whose_samples_arrive_is_not_frozen_though_it_does_not_reply():
    """On a busy machine a writer may publish and still be too slow for a reply."""
    writer = local_writer(7, "busy")
    with (
        connect() as session,
        TransformPublisher(session, "cart", "odometry") as odometry,
        announce(session, WRITER_TOKEN.key("cart", "joint_states", writer.identity)),
        repeated(lambda: odometry.publish([Transform("odom", "base", (0, 0, 0), (0, 0, 0, 1))])),
    ):
        (info,) = discover(session)
        with StreamCollector(session, [info], "native", lambda: None) as collector:
            probe = RobotProbe(collector, info, [info])
            until(lambda: probe.silent_writers() == {writer})
            state = JointState(time.time_ns(), 0, 7, order_digest(()), b"")
            session.zenoh.put("zstate/cart/joint_states", encode(state), encoding=encoding_of(JointState))
            until(lambda: not probe.silent_writers())


def test_writer_without_new_samples_is_broken():
    with connect() as session, StatePublisher(session, load_model(RRBOT)) as publisher:
        publisher.publish([0.0, 0.0])
        found = broken_link("rrbot")
    assert found["name"] == "joint_states"
    assert "no sample arrives" in found["text"]


@pytest.mark.parametrize(
    ("stamp", "cause"),
    [
        (lambda: time.time_ns() + 300 * SECOND, "after the time here"),
        (lambda: time.time_ns() + 5 * SECOND, "in the future"),
        (time.monotonic_ns, "1970 and after"),
        (lambda: 0, "1970 and after"),
        (lambda: time.time_ns() // 1_000_000, "milliseconds where nanoseconds are meant"),
    ],
)
def test_stamps_far_from_now_are_reported_with_their_cause(stamp: Callable[[], int], cause: str):
    with published_with_stamps(stamp):
        found = broken_link("rrbot")
    assert found["name"] == "stamps"
    assert cause in found["text"]
    assert f"pid {os.getpid()}" in found["text"]


def test_constant_stamps_are_broken():
    began = time.time_ns()
    with published_with_stamps(lambda: began):
        found = broken_link("rrbot")
    assert (found["name"], "the same stamp" in found["text"]) == ("stamps", True)


def test_clock_ahead_is_reported_before_its_stamps():
    class ClockAhead(SystemClock):
        def now(self) -> int:
            return super().now() + 10 * SECOND

    with (
        connect() as session,
        StatePublisher(session, load_model(RRBOT), clock=ClockAhead()) as publisher,
        repeated(lambda: publisher.publish([0.0, 0.0])),
    ):
        found = broken_link("rrbot")
    assert found["name"] == "clocks"
    assert "10.0 s ahead of this one" in found["text"]


@contextmanager
def simulated_time() -> Iterator[None]:
    """Publishes a simulated time of five seconds a hundred times a second."""
    with (
        connect() as session,
        ClockPublisher(session) as publisher,
        repeated(lambda: publisher.publish(5 * SECOND)),
    ):
        yield


def test_simulated_time_without_a_publisher_is_broken():
    clock = ManualClock(5 * SECOND, "sim")
    with (
        connect() as session,
        StatePublisher(session, load_model(RRBOT), clock=clock) as publisher,
        repeated(lambda: publisher.publish([0.0, 0.0])),
    ):
        found = broken_link("rrbot")
    assert found["name"] == "stamps"
    assert "no time was received on 'zstate/clock'" in found["text"]


def test_robots_on_different_clocks_are_a_warning():
    with (
        simulated_time(),
        published_robot("left"),
        published_robot("right", clock=ManualClock(5 * SECOND, "sim")),
    ):
        done = run_cli("doctor")
    lines = done.stdout.splitlines()
    (line,) = [line for line in lines if "different clocks" in line]
    assert line.split()[:2] == ["warning", "clocks"]
    assert "'left' in 'system' time; 'right' in 'sim' time" in line
    assert "all is sound" not in lines


def test_writer_of_a_newer_version_is_reported_as_such():
    with published_robot(), connect() as session:
        newer = session.zenoh.declare_publisher("zstate/rrbot/joint_states", encoding="zstate/JointState;v=2")
        with repeated(lambda: newer.put(b"\x90")):
            found = broken_link("rrbot")
    assert (found["name"], found["next"]) == ("version", "pip install -U zstate")
    assert "version 2" in found["text"]


def test_two_writers_of_one_stream_are_a_warning():
    with (
        published_robot(),
        connect() as session,
        StatePublisher(session, load_model(RRBOT), streams=("joint_states",), takeover=True),
    ):
        checks = diagnosed("rrbot", code=0)["checks"]
    (writers,) = [check for check in checks if check["name"] == "writers"]
    assert writers["state"] == "warning"
    assert "and so does" in writers["text"]


class StillBase:
    """A base that stands at the origin of its odometry."""

    def read(self, stamp: int) -> list[Transform]:
        return [Transform("odom", "base", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), stamp)]


@pytest.mark.usefixtures("whole_window")
def test_warning_of_a_writer_of_transforms_is_reported_though_it_keeps_its_rate():
    text = "wheels: NIS 14.2 for 3 numbers, expected 0.2 to 9.3: its sigmas are about 2 times too small"
    with connect() as session, TransformPublisher(session, "cart", "wheels", program="odometry") as odometry:
        odometry.warning = text
        thread = threading.Thread(target=odometry.run, args=(StillBase(), 50.0))
        thread.start()
        try:
            until(lambda: odometry.stats.sent > 0)
            found = warnings()["writers"]
        finally:
            odometry.close()
            thread.join()
    assert re.fullmatch(rf"odometry@\S+ pid {os.getpid()} reports: {re.escape(text)}", found)


def test_disconnected_frames_are_a_warning():
    with published_robot(), static_edges(("rrbot", "rrbot/map", "rrbot/odom")):
        assert "in 2 trees" in warnings("rrbot")["poses"]


@pytest.mark.parametrize("model_first", [True, False])
def test_static_edge_that_closes_a_loop_is_a_warning_with_its_writer(model_first: bool):
    with ExitStack() as opened:
        session = opened.enter_context(connect())
        wrong = StaticPublisher(session, "rrbot", "mix-up", program="rigger", takeover=True)
        steps = [
            lambda: opened.enter_context(published_robot()),
            lambda: wrong.set(Transform("lower", "world", (1, 0, 0), (0, 0, 0, 1))),
        ]
        opened.enter_context(wrong)
        for step in steps if model_first else reversed(steps):
            step()
        report = warnings("rrbot")
        assert json.loads(run_cli("tf", "world", "tool", "--once", "--json").stdout)["source"] == "tool"
        assert "tool" in run_cli("tree", "rrbot").stdout
    assert "tf_static" in report  # on a busy machine there may be others
    assert report["tf_static"].startswith("static edge of 'mix-up' (rigger@")
    assert "would close the loop" in report["tf_static"]


def test_static_edge_on_a_frame_of_another_robot_is_a_warning():
    with (
        published_robot("r1"),
        published_robot("r2"),
        connect() as session,
        StaticPublisher(session, "r2", "camera", takeover=True) as publisher,
    ):
        publisher.set(Transform("r1/base", "r1/camera", (1, 0, 0), (0, 0, 0, 1)))
        report = diagnosed(code=0)["checks"]
    (text,) = {check["text"] for check in report if check["name"] == "tf_static" and check["robot"] == "r2"}
    assert "'r1/camera' is a frame of robot 'r1'" in text


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("mode", ["client", "peer"])
def test_endpoint_without_a_listener_is_broken(mode: str, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    found = broken_link("--connect", endpoint, "--mode", mode)
    assert (found["name"], found["next"]) == ("network", f"zstate router --listen {endpoint}")
    assert "connection refused" in found["text"]


@pytest.mark.usefixtures("impatient")
def test_unknown_host_name_is_distinguished_from_a_refusing_host():
    found = broken_link("--connect", "tcp/no-such-host.invalid:7447")
    assert "the host name 'no-such-host.invalid' is unknown" in found["text"]


def test_another_program_at_the_rendezvous_address_is_detected(monkeypatch: pytest.MonkeyPatch):
    with socket.create_server(("127.0.0.1", find_free_port())) as server:
        monkeypatch.setenv("ZSTATE_RENDEZVOUS", "{}:{}".format(*server.getsockname()))
        found = broken_link()
    assert (found["name"], "does not answer: it is another program" in found["text"]) == ("network", True)


@pytest.mark.processes
@pytest.mark.long
def test_stopped_program_that_blocks_the_rendezvous_is_reported(
    spawn: Spawn, rendezvous: str, free_port: int, monkeypatch: pytest.MonkeyPatch
):
    keeper = spawn("import sys, zstate; s = zstate.connect(); print(s.zid); sys.stdin.readline()")
    keeper.line()
    keeper.freeze()
    process = f"process {keeper.process.pid} ("
    reason = f"has the rendezvous port {rendezvous} and does not answer: it is stopped, as by Ctrl-Z"
    found = broken_link()
    assert process in found["text"]
    assert reason in found["text"]
    assert found["next"] == f"kill -CONT {keeper.process.pid}"
    assert reason in run_cli("ls").stderr
    # With a second address, the other programs meet there and are found.
    monkeypatch.setenv("ZSTATE_RENDEZVOUS", f"{rendezvous} 127.0.0.1:{free_port}")
    with published_robot("r1"):
        assert "r1" in run_cli("ls", "--json").stdout
        report = warnings()["network"]
    assert reason in report
    assert f"the others meet at 127.0.0.1:{free_port}" in report


@pytest.fixture
def guarded(free_port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A router that lets r1 and r2 write, desk read, and r3 connect only; r1 is published behind it."""
    acl, users = tmp_path / "acl.json5", tmp_path / "users.txt"
    acl.write_text(run_cli("acl", "--robot", "r1", "--robot", "r2", "--viewer", "desk").stdout)
    users.write_text("".join(f"{name}:secret\n" for name in ("r1", "r2", "r3", "desk")))
    users.chmod(0o600)
    with (
        router(f"tcp/127.0.0.1:{free_port}", users=users, acl=acl) as endpoint,
        connect(
            mode="client", endpoints=endpoint, credentials=Credentials(user="r1", password="secret")
        ) as session,
        StatePublisher(session, load_model(RRBOT), "r1") as publisher,
        repeated(lambda: publisher.publish([0.0, 0.0])),
    ):
        monkeypatch.setenv("ZSTATE_CONNECT", endpoint)
        monkeypatch.setenv("ZSTATE_PASSWORD", "secret")
        yield endpoint


def test_viewer_behind_a_router_finds_everything_sound(guarded: str):
    assert diagnosed("r1", "--user", "desk", code=0)["sound"]


def test_identity_without_read_permission_is_reported_with_its_name(guarded: str):
    found = broken_link("r1", "--user", "r2")
    assert found["name"] == "access"
    assert "the router denies zstate/r1/** to user 'r2'" in found["text"]
    assert found["next"].startswith("zstate acl --viewer")


def test_identity_that_may_not_write_as_its_robot_gets_the_missing_rule(guarded: str):
    found = broken_link("r3", "--user", "r3")
    assert (found["name"], found["next"]) == ("access", "zstate acl --robot r3")


def test_missing_credentials_lead_to_the_option_that_sets_them(guarded: str):
    found = broken_link()
    assert found["name"] == "network"
    assert found["next"] == f"zstate doctor --connect {guarded} --user NAME"


def test_a_file_argument_is_refused_with_the_check_command():
    assert "`zstate check arm.urdf`" in failure("doctor", "arm.urdf", code=2)


def test_ros_robots_are_found_when_there_are_no_native_ones(free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with router(endpoint, ros2=True), published_robot(wire="ros2", router=endpoint):
        assert broken_link("--connect", endpoint)["next"] == f"zstate doctor --wire ros2 --connect {endpoint}"
        assert diagnosed("--wire", "ros2", "--connect", endpoint, code=0)["sound"]


@pytest.mark.usefixtures("impatient")
def test_ros_wire_without_a_router_leads_to_the_router_command(free_port: int):
    found = broken_link("--wire", "ros2", "--connect", f"tcp/127.0.0.1:{free_port}")
    assert found["next"] == "zstate router --ros2"


ARM = """<robot name="arm"><link name="base"/><link name="upper"/><link name="tip"/>
  <joint name="lift" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="spin" type="continuous"><parent link="upper"/><child link="tip"/><axis xyz="0 0 1"/></joint>
</robot>"""


@pytest.mark.parametrize(
    ("positions", "text"),
    [
        (
            (45.0, 60.0),
            "'lift' at 45.0 rad is outside -2 to 2; this looks like degrees: convert with math.radians",
        ),
        ((2.5, 0.0), "'lift' at 2.5 rad is outside -2 to 2"),
    ],
)
def test_positions_outside_joint_limits_are_a_warning_that_suspects_degrees(
    positions: tuple[float, ...], text: str
):
    with published_robot("arm", positions, model=ARM):
        report = diagnosed("arm", code=0)
    (found,) = [check for check in report["checks"] if check["state"] == "warning"]
    assert (found["name"], found["text"]) == ("limits", text)
    assert found["next"].startswith("zstate echo arm --once  # ")


def test_continuous_joint_after_many_turns_is_sound():
    with published_robot("arm", (2.0005, 900.0), model=ARM):
        assert warnings("arm") == {}


@contextmanager
def static_edges(*edges: tuple[str, str, str]) -> Iterator[None]:
    """Publishes static edges (robot, target, source), each by its own writer."""
    with ExitStack() as opened:
        session = opened.enter_context(connect())
        for number, (robot, target, source) in enumerate(edges):
            publisher = opened.enter_context(
                StaticPublisher(session, robot, f"writer{number}", takeover=True)
            )
            publisher.set(Transform(target, source, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
        yield


def test_static_target_similar_to_a_frame_is_reported_and_not_joined():
    with published_robot(), static_edges(("rrbot", "lowr", "camera")):
        report = diagnosed("rrbot", code=0)
    (found,) = [check for check in report["checks"] if check["name"] == "poses"]
    assert "'lowr', the parent of 'rrbot/camera', is similar to 'lower'" in found["text"]
    assert found["next"] == ("zstate tree rrbot  # if 'lower' is meant, start writer0 with that name")


def test_static_frame_without_similar_names_can_be_joined():
    with published_robot(), static_edges(("rrbot", "island", "palm")):
        report = diagnosed("rrbot", code=0)
    (found,) = [check for check in report["checks"] if check["name"] == "poses"]
    assert found["next"].startswith("zstate static rrbot/island rrbot/world")


def test_robots_with_a_map_each_are_advised_to_share_one():
    with (
        published_robot("a"),
        published_robot("b"),
        static_edges(("a", "map", "world"), ("b", "map", "world")),
    ):
        report = diagnosed(code=0)
    # A busy machine may also be warned of: that a robot is slower than commanded.
    (found,) = [check for check in report["checks"] if check["name"] == "frames" and check["robot"] is None]
    assert found["state"] == "warning"
    assert found["text"] == (
        "'a/map' and 'b/map' are different frames; name one that robots share in full, such as fleet/map"
    )
    assert found["next"] == "zstate static fleet/map a/world --xyz 0 0 0  # instead of a/map"


def test_robots_in_one_shared_map_and_of_one_model_are_sound():
    with (
        published_robot("a"),
        published_robot("b"),
        static_edges(("a", "fleet/map", "a/world"), ("b", "fleet/map", "b/world")),
    ):
        assert warnings() == {}


def test_second_parent_leads_to_existing_commands():
    with published_robot(), static_edges(("rrbot", "world", "lower")):
        report = diagnosed("rrbot", code=0)
    found = [check for check in report["checks"] if check["name"] == "tf_static"]
    assert {check["state"] for check in found} == {"warning"}
    assert {check["next"].partition("  #")[0] for check in found} == {"zstate tree rrbot"}
    assert not any("withdraw(" in check["text"] or "--name" in check["next"] for check in found)


def test_no_pose_is_known_with_static_edges_but_without_a_driver():
    with static_edges(("rrbot", "tool", "camera")):
        report = diagnosed("rrbot", code=1)
    (poses,) = [check for check in report["checks"] if check["name"] == "poses"]
    assert (poses["state"], poses["text"]) == ("skipped", "no joint positions")


def test_a_single_old_sample_is_a_known_pose():
    with connect() as session, StatePublisher(session, load_model(RRBOT)) as publisher:
        publisher.publish([0.1, 0.2])
        report = diagnosed("rrbot", code=1)
    (poses,) = [check for check in report["checks"] if check["name"] == "poses"]
    assert poses["state"] == "ok"
    assert "rrbot/world is known" in poses["text"]


def driver_checks(report: dict[str, Any]) -> dict[str, tuple[str, str]]:
    """State and text of the checks of a driver, by name."""
    names = ("driver", "commander", "commands")
    return {one["name"]: (one["state"], one["text"]) for one in report["checks"] if one["name"] in names}


def test_a_driver_its_commander_and_the_age_of_its_commands_are_checked(sessions, host_driver):
    host = host_driver()
    found = driver_checks(diagnosed("arm", code=0))
    program = f"driver@{socket.gethostname()} pid {os.getpid()}"
    assert found["driver"][1].startswith(f"{program}: ready; its loop runs at ")
    assert found["commander"] == ("ok", "none: no program commands 'arm'")
    assert found["commands"] == ("skipped", "the driver has accepted none yet")
    with Commander(sessions[1], "arm", program="teleop") as teleop:
        teleop.wait_for_driver(DEADLINE_S)
        with repeated(lambda: teleop.send({"elbow": 0.1})):
            until(lambda: host.state == "active")
            found = driver_checks(diagnosed("arm", code=0))
    commander = program.replace("driver", "teleop", 1)
    assert f"active, commanded by {commander}" in found["driver"][1]
    assert found["commander"] == ("ok", commander)
    assert re.fullmatch(r"the newest is [\d.]+ [mun]s old, valid for 250.0 ms at most", found["commands"][1])


def test_a_stopped_driver_is_the_broken_link_with_the_reason_and_the_release(sessions, host_driver):
    host_driver()
    stop(sessions[1], "arm", "door open", timeout_s=DEADLINE_S)
    found = broken_link("arm")
    assert found["name"] == "driver"
    assert re.search(r": stopped by .*: door open$", found["text"])
    assert found["next"] == "zstate stop arm --release  # when it may move again"


def test_a_commander_without_a_driver_is_broken(sessions):
    with published_robot("arm"), Commander(sessions[0], "arm", program="teleop"):
        found = broken_link("arm")
    assert found["name"] == "driver"
    assert found["text"].endswith("commands 'arm', which has no driver that publishes its state")
