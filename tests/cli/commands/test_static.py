from __future__ import annotations

from pathlib import Path

import pytest
from helpers.cli_runner import Spawn, failure, interrupted, published_robot, started
from helpers.processes import until

from zstate import StaticPublisher, Transform, TransformListener, connect
from zstate.cli.frame_checks import unknown_target_warnings
from zstate.cli.up.cell import StaticSection

POSE = ("--xyz", "0.1", "0", "-0.2", "--rpy-deg", "0", "0", "90")


@pytest.mark.processes
def test_edge_is_published_until_ctrl_c_and_then_withdrawn(spawn: Spawn):
    with published_robot(), connect() as session, TransformListener(session, "rrbot") as listener:
        child = started(spawn, "static", "lower", "flange", *POSE)
        sentence = child.line()
        assert sentence.startswith(
            "pose of flange in lower: xyz [0.1, 0, -0.2] m, rpy [0, 0, 90] deg, until Ctrl-C (robot 'rrbot'"
        )
        placed = listener.buffer.wait("lower", "flange", timeout_s=10.0)
        # A quarter turn about z takes x to y: half the angle is 45 degrees.
        assert placed.translation.tolist() == [0.1, 0.0, -0.2]
        assert abs(placed.rotation - [0.0, 0.0, 0.5**0.5, 0.5**0.5]).max() < 1e-12
        interrupted(child)
        until(lambda: not listener.buffer.can_lookup("lower", "flange"))


@pytest.mark.processes
def test_several_writers_coexist_and_a_full_name_needs_no_robot(spawn: Spawn):
    started(spawn, "static", "fleet/map", "r1/odom", *POSE).line()
    started(spawn, "static", "r1/odom", "beacon", *POSE).line()
    with connect() as session, TransformListener(session) as listener:
        both = listener.buffer.wait("fleet/map", "r1/beacon", timeout_s=10.0)
    # The second offset is turned by the first: x goes to y.
    assert abs(both.translation - [0.1, 0.1, -0.4]).max() < 1e-12


@pytest.mark.processes
def test_a_file_places_all_its_edges(spawn: Spawn, tmp_path: Path):
    file = tmp_path / "cell.toml"
    file.write_text(
        """
        [[static]]
        target = "r1/base"
        source = "camera"
        xyz = [1, 0, 0]
        quat_xyzw = [0, 0, 0, 1]
        [[static]]
        robot = "r1"
        target = "camera"
        source = "lens"
        xyz = [0, 0, 2]
        """
    )
    child = started(spawn, "static", "--file", str(file))
    child.line()
    child.line()
    with connect() as session, TransformListener(session) as listener:
        lens = listener.buffer.wait("r1/base", "r1/lens", timeout_s=10.0)
    assert lens.translation.tolist() == [1.0, 0.0, 2.0]


@pytest.mark.processes
def test_edge_belongs_to_the_selected_robot(spawn: Spawn):
    with published_robot(), connect() as session, TransformListener(session, placers=["site"]) as listener:
        child = started(spawn, "static", "site/map", "rrbot/world", "--xyz", "1", "0", "0", "--robot", "site")
        assert "(robot 'site'" in child.line()
        assert listener.buffer.wait("site/map", "rrbot/base", timeout_s=10.0).kind == "static"
        edge = ("rrbot/base", "rrbot/camera", "--xyz", "1", "0", "0", "--robot", "site")
        assert "'rrbot/camera' is a frame of robot 'rrbot'" in failure("static", *edge)
        edge = ("lower", "world", "--xyz", "1", "0", "0", "--robot", "rrbot")
        assert "would close the loop" in failure("static", *edge)


def test_edge_without_a_known_robot_is_refused_with_the_robot_option():
    message = failure("static", "a", "b", *POSE)
    assert "--robot NAME (no robot is announced" in message


def test_edge_with_two_candidate_robots_is_refused_with_their_names():
    with published_robot("left"), published_robot("right"):
        message = failure("static", "lower", "flange", *POSE)
    assert "--robot NAME (announced: 'left', 'right')" in message


def test_invalid_pose_error_names_the_reason():
    xyz = ("--xyz", "0", "0", "0")
    assert "2 rotations" in failure("static", "r/a", "b", *POSE, "--rpy", "0", "0", "0")
    assert "length 2" in failure("static", "r/a", "b", *xyz, "--quat-xyzw", "0", "0", "0", "2")
    assert "finite" in failure("static", "r/a", "b", "--xyz", "nan", "0", "0", "--rpy", "0", "0", "0")
    assert "itself" in failure("static", "r/a", "r/a", *POSE)


@pytest.mark.processes
def test_omitted_rotation_or_translation_is_zero(spawn: Spawn):
    placed, turned = "r/a", "r/b"
    sentence = started(spawn, "static", "r/base", placed, "--xyz", "1", "2", "3").line()
    assert "xyz [1, 2, 3] m, rpy [0, 0, 0] deg" in sentence
    sentence = started(spawn, "static", "r/base", turned, "--rpy-deg", "0", "0", "90").line()
    assert "xyz [0, 0, 0] m, rpy [0, 0, 90] deg" in sentence


def test_half_an_edge_is_wrong_usage():
    assert "--xyz" in failure("static", "a", "b", code=2)
    assert "TARGET" in failure("static", "--xyz", "0", "0", "0", code=2)


@pytest.mark.processes
def test_edge_of_a_file_is_published_on_each_of_its_wires(spawn: Spawn, ros_router: str, tmp_path: Path):
    file = tmp_path / "cell.toml"
    file.write_text(
        '[parameters]\nheight = 1.0\n[[static]]\nrobot = "arm"\ntarget = "tool"\nsource = "camera"\n'
        'xyz = [0, 0, "${height}"]\nwires = ["native", "ros2"]\n'
    )
    child = started(spawn, "static", "--file", str(file), "--set", "height=2.5")
    line = child.line()
    assert "xyz [0, 0, 2.5] m" in line
    assert "also on ROS 2 topic /tf_static" in line
    with connect(mode="client", endpoints=ros_router) as session:
        for wire in ("native", "ros2"):
            with TransformListener(session, wire=wire) as listener:
                assert listener.buffer.wait("tool", "camera", timeout_s=10.0).translation[2] == 2.5


@pytest.mark.processes
def test_target_similar_to_a_frame_of_the_robot_gets_a_warning(spawn: Spawn):
    with published_robot():
        child = started(spawn, "static", "lowr", "flange", *POSE)
        child.line()
        until(lambda: "did you mean" in child.stderr)
        interrupted(child)
    assert "'rrbot' has no frame 'lowr'; did you mean 'lower'" in child.stderr


@pytest.mark.processes
def test_new_target_above_the_robot_is_advised_to_be_a_shared_frame(spawn: Spawn):
    with published_robot():
        child = started(spawn, "static", "map", "world", *POSE)
        child.line()
        until(lambda: "warning" in child.stderr)
        interrupted(child)
    assert (
        "'rrbot/map' is a new frame of 'rrbot' alone; name a frame that robots share in full" in child.stderr
    )
    assert "for instance fleet/map" in child.stderr


@pytest.mark.processes
@pytest.mark.parametrize(
    "edge",
    [
        ("lower", "flange"),
        ("lowr", "flange", "--new"),
        ("fleet/map", "rrbot/world"),
    ],
)
def test_known_new_and_shared_targets_cause_no_warning(spawn: Spawn, edge: tuple[str, ...]):
    with published_robot(), connect() as session:
        publisher = StaticPublisher(session, "rrbot", "here")
        target, source, *new = edge
        transform = Transform(target, source, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        if new:
            child = started(spawn, "static", *edge, *POSE)
            child.line()
            interrupted(child)
            assert "warning" not in child.stderr
        else:
            assert unknown_target_warnings(session, publisher, [transform]) == []


def test_a_chain_of_edges_that_are_published_together_is_known():
    chain = [("lower", "mount"), ("mount", "camera"), ("camera", "lens"), ("mont", "light")]
    with published_robot(), connect() as session, StaticPublisher(session, "rrbot", "chain") as publisher:
        edges = [Transform(*names, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)) for names in chain]
        (warning,) = unknown_target_warnings(session, publisher, edges)
    assert (
        warning
        == "'rrbot' has no frame 'mont': 'rrbot/light' is not joined to it (--new if it is a new frame)"
    )


def test_a_static_frame_of_another_writer_is_known_and_has_near_misses():
    upright = ((1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    with (
        connect() as session,
        StaticPublisher(session, "fleet", "site") as site,
        StaticPublisher(session, "fleet", "here") as here,
    ):
        site.set(Transform("map", "hall", *upright))
        assert unknown_target_warnings(session, here, [Transform("hall", "gate", *upright)]) == []
        (warning,) = unknown_target_warnings(session, here, [Transform("hal", "gate", *upright)])
    assert warning.startswith("'fleet' has no frame 'hal'; did you mean 'hall'?")


def test_radians_beyond_a_turn_ask_for_degrees(tmp_path: Path):
    message = failure("static", "r/a", "b", "--xyz", "0", "0", "0", "--rpy", "0", "-90", "0")
    assert "none beyond 2 pi; got 0, -90, 0" in message
    assert "to give degrees use --rpy-deg 0 -90 0 (in a file: rpy_deg)" in message
    file = tmp_path / "cell.toml"
    file.write_text('[[static]]\ntarget = "r/a"\nsource = "b"\nrpy = [0, -90, 0]\n')
    assert "none beyond 2 pi; got 0, -90, 0" in failure("static", "--file", str(file))


def test_degrees_may_be_more_than_a_turn():
    turned = StaticSection("r/a", "b", rpy_deg=(0.0, 0.0, 450.0)).transform()
    assert abs(turned.rotation - [0.0, 0.0, 0.5**0.5, 0.5**0.5]).max() < 1e-12
