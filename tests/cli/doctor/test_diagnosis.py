from __future__ import annotations

import json
import os
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from helpers.cli_runner import ALL_STREAMS, RRBOT, Spawn, failure, published_robot, started, zstate
from helpers.processes import find_free_port, repeated

from zstate import StatePublisher, StaticPublisher, Transform, connect, load_model
from zstate.clock import ManualClock, SystemClock
from zstate.nodes.clock import ClockPublisher
from zstate.wire.keys import Stream

pytestmark = pytest.mark.processes

SECOND = 1_000_000_000
LINKS = ["zstate", "network", "robots", "writers", "model", "joint_states", "clocks", "stamps"]


def diagnosed(*arguments: str, code: int) -> dict[str, Any]:
    """What doctor says to a program; of a link that is broken by its name."""
    ended = zstate("doctor", *arguments, "--json", "--timeout", "2")
    assert ended.returncode == code, (ended.stdout, ended.stderr)
    assert ended.stderr == b""
    return json.loads(ended.stdout)


def broken_link(*arguments: str) -> dict[str, str]:
    """The first link that is broken."""
    said = diagnosed(*arguments, code=1)
    assert not said["sound"]
    return said["first_broken"]


def warnings(*arguments: str) -> dict[str, str]:
    """What is said of the links that might not hold, while none is broken."""
    checks = diagnosed(*arguments, code=0)["checks"]
    return {check["name"]: check["text"] for check in checks if check["state"] == "warning"}


@contextmanager
def stamping(stamp: Callable[[], int], streams: tuple[Stream, ...] = ALL_STREAMS) -> Iterator[None]:
    """rrbot, a hundred times a second, with stamps as ``stamp`` says."""
    with (
        connect() as session,
        StatePublisher(session, load_model(RRBOT), streams=streams) as publisher,
        repeated(lambda: publisher.publish([0.0, 0.0], stamp=stamp())),
    ):
        yield


def test_of_a_robot_that_is_well_every_link_is_ok(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ZSTATE_KERNEL", "reference")  # wanted, it is no worry
    with published_robot():
        said = diagnosed("rrbot", code=0)
        text = zstate("doctor", "rrbot").stdout.decode()
    assert said["sound"]
    assert said["first_broken"] is None
    assert [check["name"] for check in said["checks"]] == [*LINKS, "tf_static", "poses"]
    assert {check["state"] for check in said["checks"]} == {"ok"}, said
    assert text.endswith("all is sound\n")
    assert "\x1b" not in text


def test_of_several_robots_one_line_is_enough_for_those_that_are_well():
    with published_robot("left"), published_robot("right", streams=("tf_static", "robot_description")):
        lines = zstate("doctor").stdout.decode().splitlines()
    (left,) = [line for line in lines if "left" in line and "announced" not in line]
    assert left.split()[:2] == ["ok", "left"]
    assert lines[-2] == "first broken link: joint_states of 'right'"
    assert lines[-1].startswith("next: zstate joints FILE --name right")


def test_where_nobody_is_it_says_how_to_begin():
    found = broken_link()
    assert (found["name"], found["next"]) == ("robots", "zstate publish panda --source sine")
    assert "no robot is announced" in found["text"]


def test_a_robot_that_is_not_there_is_told_from_those_that_are():
    with published_robot():
        found = broken_link("rbot")
    assert found["text"] == "nobody announces the robot 'rbot'; announced: 'rrbot'"
    assert found["next"] == "zstate doctor rrbot"


def test_robots_on_the_other_side_of_an_option_are_found(spawn: Spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    started(spawn, "router", "--listen", endpoint).line()
    with published_robot():
        found = broken_link("--connect", endpoint)
    assert "'rrbot'" in found["text"]
    assert found["next"] == "zstate doctor rrbot"


def test_where_the_router_is_missing_robots_of_this_host_are_found(free_port: int):
    with published_robot():
        found = broken_link("--connect", f"tcp/127.0.0.1:{free_port}")
    assert found["name"] == "network"
    assert "without --connect, among the programs of this host: 'rrbot'" in found["text"]


def test_a_robot_without_its_driver_lacks_joint_states():
    with connect() as session, StatePublisher(session, load_model(RRBOT), streams=ALL_STREAMS[1:]):
        found = broken_link("rrbot")
    assert (found["name"], found["robot"]) == ("joint_states", "rrbot")
    assert "nobody writes joint_states of 'rrbot'" in found["text"]


def test_a_driver_that_calls_the_robot_otherwise_is_found():
    with (
        published_robot("rrbot1", streams=("joint_states",)),
        connect() as session,
        StatePublisher(session, load_model(RRBOT), streams=ALL_STREAMS[1:]),
    ):
        found = broken_link("rrbot")
    assert "'rrbot1', of which there are joint_states and no model" in found["text"]
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


def test_a_writer_that_is_stopped_is_told_from_one_that_is_gone(spawn: Spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    started(spawn, "router", "--listen", endpoint).line()
    child = started(spawn, "publish", RRBOT, "--source", "sine", "--connect", endpoint)
    child.line()
    assert zstate("wait", "robot", "rrbot", "--connect", endpoint).returncode == 0
    os.kill(child.process.pid, signal.SIGSTOP)
    found = broken_link("rrbot", "--connect", endpoint)
    assert found["name"] == "writers"
    assert "stopped" in found["text"]
    assert str(child.process.pid) in found["next"]


def test_a_writer_that_is_given_nothing_new_says_so():
    with connect() as session, StatePublisher(session, load_model(RRBOT)) as publisher:
        publisher.publish([0.0, 0.0])
        found = broken_link("rrbot")
    assert found["name"] == "joint_states"
    assert "no sample comes" in found["text"]


@pytest.mark.parametrize(
    ("stamp", "told"),
    [
        (lambda: time.time_ns() + 300 * SECOND, "after the time here"),
        (lambda: time.time_ns() + 5 * SECOND, "in the future"),
        (time.monotonic_ns, "1970 and after"),
        (lambda: 0, "1970 and after"),
        (lambda: time.time_ns() // 1_000_000, "milliseconds where nanoseconds are meant"),
    ],
)
def test_stamps_far_from_the_time_are_named_with_their_cause(stamp: Callable[[], int], told: str):
    with stamping(stamp):
        found = broken_link("rrbot")
    assert found["name"] == "stamps"
    assert told in found["text"]
    assert f"pid {os.getpid()}" in found["text"]


def test_stamps_that_stand_still_are_named():
    began = time.time_ns()
    with stamping(lambda: began):
        found = broken_link("rrbot")
    assert (found["name"], "the same stamp" in found["text"]) == ("stamps", True)


def test_a_clock_that_is_ahead_is_broken_before_the_stamps_it_makes():
    class Ahead(SystemClock):
        def now(self) -> int:
            return super().now() + 10 * SECOND

    with (
        connect() as session,
        StatePublisher(session, load_model(RRBOT), clock=Ahead()) as publisher,
        repeated(lambda: publisher.publish([0.0, 0.0])),
    ):
        found = broken_link("rrbot")
    assert found["name"] == "clocks"
    assert "10.0 s ahead of this one" in found["text"]


@contextmanager
def simulated_time() -> Iterator[None]:
    """A simulated time of five seconds, a hundred times a second."""
    with (
        connect() as session,
        ClockPublisher(session) as publisher,
        repeated(lambda: publisher.publish(5 * SECOND)),
    ):
        yield


def test_simulated_time_that_nobody_tells_is_missed():
    clock = ManualClock(5 * SECOND, "sim")
    with (
        connect() as session,
        StatePublisher(session, load_model(RRBOT), clock=clock) as publisher,
        repeated(lambda: publisher.publish([0.0, 0.0])),
    ):
        found = broken_link("rrbot")
    assert found["name"] == "stamps"
    assert "no time was received on 'zstate/clock'" in found["text"]


def test_robots_with_different_clocks_are_a_warning_that_names_them():
    with (
        simulated_time(),
        published_robot("left"),
        published_robot("right", clock=ManualClock(5 * SECOND, "sim")),
    ):
        done = zstate("doctor")
    lines = done.stdout.decode().splitlines()
    (told,) = [line for line in lines if "different clocks" in line]
    assert told.split()[:2] == ["warning", "clocks"]
    assert "'left' in 'system' time; 'right' in 'sim' time" in told
    assert "all is sound" not in lines


def test_a_writer_of_a_newer_version_is_named_as_such():
    with published_robot(), connect() as session:
        newer = session.zenoh.declare_publisher("zstate/rrbot/joint_states", encoding="zstate/JointState;v=2")
        with repeated(lambda: newer.put(b"\x90")):
            found = broken_link("rrbot")
    assert (found["name"], found["next"]) == ("version", "pip install -U zstate")
    assert "version 2" in found["text"]


def test_two_who_write_the_same_are_a_warning():
    with (
        published_robot(),
        connect() as session,
        StatePublisher(session, load_model(RRBOT), streams=("joint_states",), takeover=True),
    ):
        checks = diagnosed("rrbot", code=0)["checks"]
    (writers,) = [check for check in checks if check["name"] == "writers"]
    assert writers["state"] == "warning"
    assert "and so does" in writers["text"]


def test_frames_that_hang_together_with_nothing_are_a_warning(spawn: Spawn):
    child = started(spawn, "static", "rrbot/map", "rrbot/odom", "--xyz", "0", "0", "1")
    child.line()
    with published_robot():
        assert "in 2 trees" in warnings("rrbot")["poses"]


@pytest.mark.parametrize("model_first", [True, False])
def test_a_static_edge_that_would_hide_the_robot_is_a_warning_with_its_writer(model_first: bool):
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
        said = warnings("rrbot")
        assert json.loads(zstate("tf", "world", "tool", "--once", "--json").stdout)["source"] == "tool"
        assert "tool" in zstate("tree", "rrbot").stdout.decode()
    assert "tf_static" in said  # beside it, a machine under load may be late
    assert said["tf_static"].startswith("static edge of 'mix-up' (rigger@")
    assert "would close the loop" in said["tf_static"]


def test_a_static_edge_that_places_another_robots_frames_is_a_warning():
    with (
        published_robot("r1"),
        published_robot("r2"),
        connect() as session,
        StaticPublisher(session, "r2", "thief", takeover=True) as thief,
    ):
        thief.set(Transform("r1/base", "r1/camera", (1, 0, 0), (0, 0, 0, 1)))
        said = diagnosed(code=0)["checks"]
    (text,) = {check["text"] for check in said if check["name"] == "tf_static" and check["robot"] == "r2"}
    assert "'r1/camera' is a frame of robot 'r1'" in text


@pytest.mark.parametrize("mode", ["client", "peer"])
def test_an_endpoint_where_nobody_listens_is_refused(mode: str, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    found = broken_link("--connect", endpoint, "--mode", mode)
    assert (found["name"], found["next"]) == ("network", f"zstate router --listen {endpoint}")
    assert "connection refused" in found["text"]


def test_a_name_that_is_no_host_is_told_from_a_host_that_refuses():
    found = broken_link("--connect", "tcp/no-such-host.invalid:7447")
    assert "'no-such-host.invalid' is not known here" in found["text"]


def test_a_stranger_at_the_rendezvous_is_seen(monkeypatch: pytest.MonkeyPatch):
    with socket.create_server(("127.0.0.1", find_free_port())) as stranger:
        monkeypatch.setenv("ZSTATE_RENDEZVOUS", "{}:{}".format(*stranger.getsockname()))
        found = broken_link()
    assert (found["name"], "does not answer: it is another program" in found["text"]) == ("network", True)


def test_a_stopped_program_that_keeps_the_others_from_meeting_is_named_by_whoever_finds_nobody(
    spawn: Spawn, rendezvous: str, free_port: int, monkeypatch: pytest.MonkeyPatch
):
    keeper = spawn("import sys, zstate; s = zstate.connect(); print(s.zid); sys.stdin.readline()")
    keeper.line()
    os.kill(keeper.process.pid, signal.SIGSTOP)
    why = f"programs of this host meet at {rendezvous}, and process {keeper.process.pid} ("
    found = broken_link()
    assert why in found["text"]
    assert "does not answer: it is stopped, as by Ctrl-Z" in found["text"]
    assert found["next"] == f"kill -CONT {keeper.process.pid}"
    assert why in zstate("ls").stderr.decode()
    # The same with a second address: there the others meet, and are found.
    monkeypatch.setenv("ZSTATE_RENDEZVOUS", f"{rendezvous} 127.0.0.1:{free_port}")
    with published_robot("r1"):
        assert b"r1" in zstate("ls", "--json").stdout
        said = warnings()["network"]
    assert why in said
    assert f"the others meet at 127.0.0.1:{free_port} meanwhile" in said


@pytest.fixture
def guarded(spawn: Spawn, free_port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A router that lets r1 be r1, desk look, and r3 in without a right to anything; r1 is there."""
    acl, users = tmp_path / "acl.json5", tmp_path / "users.txt"
    acl.write_bytes(zstate("acl", "--robot", "r1", "--robot", "r2", "--viewer", "desk").stdout)
    users.write_text("".join(f"{name}:secret\n" for name in ("r1", "r2", "r3", "desk")))
    users.chmod(0o600)
    endpoint = f"tcp/127.0.0.1:{free_port}"
    started(spawn, "router", "--listen", endpoint, "--acl", str(acl), "--users", str(users)).line()
    monkeypatch.setenv("ZSTATE_CONNECT", endpoint)
    monkeypatch.setenv("ZSTATE_PASSWORD", "secret")
    started(spawn, "publish", RRBOT, "--name", "r1", "--source", "sine", "--user", "r1").line()
    return endpoint


def test_who_may_read_finds_all_well_behind_a_router(guarded: str):
    assert diagnosed("r1", "--user", "desk", code=0)["sound"]


def test_who_sees_a_robot_and_may_not_read_it_is_told_whom_the_router_took_them_for(guarded: str):
    found = broken_link("r1", "--user", "r2")
    assert found["name"] == "access"
    assert "the router denies zstate/r1/** to user 'r2'" in found["text"]
    assert found["next"].startswith("zstate acl --viewer")


def test_who_may_not_write_as_the_robot_they_are_called_like_is_told_the_rule(guarded: str):
    found = broken_link("r3", "--user", "r3")
    assert (found["name"], found["next"]) == ("access", "zstate acl --robot r3")


def test_who_shows_nothing_to_a_router_that_asks_is_told_what_to_show(guarded: str):
    found = broken_link()
    assert found["name"] == "network"
    assert found["next"] == f"zstate doctor --connect {guarded} --user NAME"


def test_a_file_is_for_another_command():
    assert "`zstate check arm.urdf`" in failure("doctor", "arm.urdf", code=2)


def test_robots_of_ros_are_found_where_there_are_no_others(spawn: Spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    started(spawn, "router", "--ros2", "--listen", endpoint).line()
    ros = ("--wire", "ros2", "--connect", endpoint)
    started(spawn, "publish", RRBOT, "--source", "sine", *ros).line()
    assert broken_link("--connect", endpoint)["next"] == f"zstate doctor --wire ros2 --connect {endpoint}"
    assert diagnosed(*ros, code=0)["sound"]


def test_a_ros_wire_without_a_router_is_told_how_to_begin(free_port: int):
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
def test_positions_outside_joint_limits_are_a_warning_that_names_degrees(
    positions: tuple[float, ...], text: str
):
    with published_robot("arm", positions, model=ARM):
        said = diagnosed("arm", code=0)
    (found,) = [check for check in said["checks"] if check["state"] == "warning"]
    assert (found["name"], found["text"]) == ("limits", text)
    assert found["next"].startswith("zstate echo arm --once  # ")


def test_a_wheel_that_has_turned_often_is_sound():
    with published_robot("arm", (2.0005, 900.0), model=ARM):
        assert warnings("arm") == {}


@contextmanager
def static_edges(*edges: tuple[str, str, str]) -> Iterator[None]:
    """Static edges of robots: (robot, target, source), of a writer each."""
    with ExitStack() as opened:
        session = opened.enter_context(connect())
        for number, (robot, target, source) in enumerate(edges):
            publisher = opened.enter_context(
                StaticPublisher(session, robot, f"writer{number}", takeover=True)
            )
            publisher.set(Transform(target, source, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
        yield


def test_a_static_target_that_is_nearly_a_frame_is_named_and_not_joined():
    with published_robot(), static_edges(("rrbot", "lowr", "camera")):
        said = diagnosed("rrbot", code=0)
    (found,) = [check for check in said["checks"] if check["name"] == "poses"]
    assert "'lowr' is near 'lower', and 'rrbot/camera' is on it" in found["text"]
    assert found["next"] == ("zstate tree rrbot  # if 'lower' is meant, start writer0 with that name")


def test_a_static_frame_like_no_other_may_be_joined():
    with published_robot(), static_edges(("rrbot", "island", "palm")):
        said = diagnosed("rrbot", code=0)
    (found,) = [check for check in said["checks"] if check["name"] == "poses"]
    assert found["next"].startswith("zstate static rrbot/island rrbot/world")


def test_robots_with_a_map_each_are_led_to_one_that_they_share():
    with (
        published_robot("a"),
        published_robot("b"),
        static_edges(("a", "map", "world"), ("b", "map", "world")),
    ):
        said = diagnosed(code=0)
    (found,) = [check for check in said["checks"] if check["state"] == "warning"]
    assert (found["name"], found["robot"]) == ("frames", None)
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


def test_a_second_parent_leads_to_commands_that_exist():
    with published_robot(), static_edges(("rrbot", "world", "lower")):
        said = diagnosed("rrbot", code=0)
    worrying = [check for check in said["checks"] if check["name"] == "tf_static"]
    assert {check["state"] for check in worrying} == {"warning"}
    assert {check["next"].partition("  #")[0] for check in worrying} == {"zstate tree rrbot"}
    assert not any("withdraw(" in check["text"] or "--name" in check["next"] for check in worrying)


def test_of_a_dead_driver_beside_a_static_edge_no_pose_is_called_known():
    with static_edges(("rrbot", "tool", "camera")):
        said = diagnosed("rrbot", code=1)
    (poses,) = [check for check in said["checks"] if check["name"] == "poses"]
    assert (poses["state"], poses["text"]) == ("skipped", "no joint positions")


def test_a_single_sample_of_the_past_is_a_pose():
    with connect() as session, StatePublisher(session, load_model(RRBOT)) as publisher:
        publisher.publish([0.1, 0.2])
        said = diagnosed("rrbot", code=1)
    (poses,) = [check for check in said["checks"] if check["name"] == "poses"]
    assert poses["state"] == "ok"
    assert "rrbot/world is known" in poses["text"]
