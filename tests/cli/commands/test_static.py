from __future__ import annotations

import math
from pathlib import Path

import pytest
from helpers.cli_runner import failure, found_pose, published_robot, run_until
from helpers.processes import until

from zstate import StaticPublisher, Transform, TransformListener, connect
from zstate.cli.frame_checks import unknown_target_warnings
from zstate.cli.up.cell import StaticSection

POSE = ("--xyz", "0.1", "0", "-0.2", "--rpy-deg", "0", "0", "90")


def test_edge_is_published_until_ctrl_c_and_then_withdrawn():
    edge = ("lower", "flange")
    with published_robot(), connect() as session, TransformListener(session, "rrbot") as listener:
        ended, placed = run_until(
            lambda: found_pose(listener, *edge), "static", *edge, *POSE, after="pose of flange"
        )
        until(lambda: not listener.buffer.can_lookup(*edge))
    assert ended.stdout.startswith(
        "pose of flange in lower: xyz [0.1, 0, -0.2] m, rpy [0, 0, 90] deg, until Ctrl-C (robot 'rrbot'"
    )
    # A quarter turn about z takes x to y: half the angle is 45 degrees.
    assert placed.translation.tolist() == [0.1, 0.0, -0.2]
    assert abs(placed.rotation - [0.0, 0.0, 0.5**0.5, 0.5**0.5]).max() < 1e-12


def test_several_writers_coexist_and_a_full_name_needs_no_robot():
    with (
        connect() as session,
        StaticPublisher(session, "r1", "other") as other,
        TransformListener(session) as listener,
    ):
        other.set(Transform.from_rpy("fleet/map", "r1/odom", (0.1, 0.0, -0.2), (0.0, 0.0, math.pi / 2)))
        edge = ("r1/odom", "beacon")
        _, both = run_until(lambda: found_pose(listener, "fleet/map", "r1/beacon"), "static", *edge, *POSE)
    # The second offset is turned by the first: x goes to y.
    assert abs(both.translation - [0.1, 0.1, -0.4]).max() < 1e-12


def test_a_file_places_all_its_edges(tmp_path: Path):
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
    with connect() as session, TransformListener(session) as listener:
        ended, lens = run_until(
            lambda: found_pose(listener, "r1/base", "r1/lens"),
            "static",
            "--file",
            str(file),
            after="pose of lens",
        )
    assert len(ended.stdout.splitlines()) == 2
    assert lens.translation.tolist() == [1.0, 0.0, 2.0]


def test_edge_belongs_to_the_selected_robot():
    with published_robot(), connect() as session, TransformListener(session, placers=["site"]) as listener:
        edge = ("site/map", "rrbot/world", "--xyz", "1", "0", "0", "--robot", "site")
        ended, pose = run_until(
            lambda: found_pose(listener, "site/map", "rrbot/base"), "static", *edge, after="(robot 'site'"
        )
        assert "(robot 'site'" in ended.stdout
        assert pose.kind == "static"
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


def test_omitted_rotation_or_translation_is_zero():
    for given, sentence in (
        (("--xyz", "1", "2", "3"), "xyz [1, 2, 3] m, rpy [0, 0, 0] deg"),
        (("--rpy-deg", "0", "0", "90"), "xyz [0, 0, 0] m, rpy [0, 0, 90] deg"),
    ):
        run_until(lambda: True, "static", "r/base", "r/camera", *given, after=sentence)


def test_half_an_edge_is_wrong_usage():
    assert "--xyz" in failure("static", "a", "b", code=2)
    assert "TARGET" in failure("static", "--xyz", "0", "0", "0", code=2)


def test_edge_of_a_file_is_published_on_each_of_its_wires(ros_router: str, tmp_path: Path):
    file = tmp_path / "cell.toml"
    file.write_text(
        '[parameters]\nheight = 1.0\n[[static]]\nrobot = "arm"\ntarget = "tool"\nsource = "camera"\n'
        'xyz = [0, 0, "${height}"]\nwires = ["native", "ros2"]\n'
    )
    with (
        connect(mode="client", endpoints=ros_router) as session,
        TransformListener(session) as native,
        TransformListener(session, wire="ros2") as ros,
    ):

        def found() -> list[Transform] | None:
            poses = [found_pose(listener, "tool", "camera") for listener in (native, ros)]
            return [pose for pose in poses if pose] if all(poses) else None

        ended, poses = run_until(
            found, "static", "--file", str(file), "--set", "height=2.5", after="topic /tf_static"
        )
    assert "xyz [0, 0, 2.5] m" in ended.stdout
    assert "also on ROS 2 topic /tf_static" in ended.stdout
    assert [pose.translation[2] for pose in poses] == [2.5, 2.5]


def test_target_similar_to_a_frame_of_the_robot_gets_a_warning():
    with published_robot():
        ended, _ = run_until(lambda: True, "static", "lowr", "flange", *POSE, after="did you mean")
    assert "'rrbot' has no frame 'lowr'; did you mean 'lower'" in ended.stderr


def test_new_target_above_the_robot_is_advised_to_be_a_shared_frame():
    with published_robot():
        ended, _ = run_until(lambda: True, "static", "map", "world", *POSE, after="for instance fleet/map")
    assert "warning" in ended.stderr
    assert (
        "'rrbot/map' is a new frame of 'rrbot' alone; name a frame that robots share in full" in ended.stderr
    )


@pytest.mark.parametrize("edge", [("lower", "flange"), ("fleet/map", "rrbot/world")])
def test_known_and_shared_targets_cause_no_warning(edge: tuple[str, str]):
    with published_robot(), connect() as session:
        publisher = StaticPublisher(session, "rrbot", "here")
        transform = Transform(*edge, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        assert unknown_target_warnings(session, publisher, [transform]) == []


def test_new_target_causes_no_warning_if_it_is_said_to_be_new():
    with published_robot():
        ended, _ = run_until(lambda: True, "static", "lowr", "flange", "--new", *POSE)
    assert "warning" not in ended.stderr


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
