"""PartialStatePublisher: the joints of one robot come from several programs."""

import time
from contextlib import contextmanager

import numpy as np
import pytest
from helpers.processes import DEADLINE_S, until
from helpers.robots import RRBOT, assert_pose, kinematic_pose
from helpers.urdf_text import joint

from zstate.errors import Closed, InFuture, InvalidInput, NoData, SecondWriter
from zstate.model.load import load_model
from zstate.net.discovery import discover
from zstate.nodes.listener import TransformListener
from zstate.nodes.partial_publisher import PartialStatePublisher
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.transform import Transform

MS = 1_000_000
SHOULDER, ELBOW = RRBOT.joint_names

SECOND_DRIVER = rf"gripper\.py.* joint '{ELBOW}' of 'r1'; refused: 'both\.py"
LIMIT = '<limit lower="-3" upper="3" velocity="1" effort="1"/>'
SIDEWAYS = f'<axis xyz="0 1 0"/>{LIMIT}'
FINGERS = load_model(
    '<robot name="fingers"><link name="palm"/><link name="left"/><link name="right"/><link name="wrist"/>'
    + joint("turn", "revolute", "wrist", "palm", f'<axis xyz="0 0 1"/>{LIMIT}')
    + joint("open", "prismatic", "palm", "left", SIDEWAYS)
    + joint("follow", "prismatic", "palm", "right", f'{SIDEWAYS}<mimic joint="open" multiplier="-1"/>')
    + "</robot>"
)


def described(session, model=RRBOT, robot="r1"):
    return StatePublisher(session, model, robot, streams=("robot_description",))


@contextmanager
def shoulder_and_elbow(first, second):
    """The two drivers of a described robot."""
    with (
        described(first),
        PartialStatePublisher(first, RRBOT, [SHOULDER], "r1", program="arm.py") as lower,
        PartialStatePublisher(second, RRBOT, [ELBOW], "r1", program="wrist.py") as upper,
    ):
        yield lower, upper


def test_each_joint_is_interpolated_between_the_samples_of_its_own_driver(sessions):
    first, second = sessions
    stamp = time.time_ns()
    with shoulder_and_elbow(first, second) as (lower, upper), TransformListener(second, "r1") as listener:
        lower.publish([0.0], stamp=stamp)
        lower.publish([1.0], stamp=stamp + 100 * MS)
        upper.publish({ELBOW: 2.0}, stamp=stamp + 20 * MS)
        upper.publish({ELBOW: 0.0}, stamp=stamp + 60 * MS)
        found = listener.buffer.wait("world", RRBOT.links[-1], stamp + 30 * MS, timeout_s=DEADLINE_S)
        # The shoulder is 30 ms into 100 ms, the elbow 10 ms into 40 ms.
        assert_pose(found, kinematic_pose(RRBOT, [0.3, 1.5], "world", RRBOT.links[-1]))
        positions, at = listener.buffer.joint_positions("r1", stamp + 30 * MS)
        assert (positions, at) == (pytest.approx([0.3, 1.5]), stamp + 30 * MS)
        # The newest instant that both have reached is the elbow's last sample.
        positions, at = listener.buffer.joint_positions("r1")
        assert (positions, at) == (pytest.approx([0.6, 0.0]), stamp + 60 * MS)


def test_a_driver_that_stops_leaves_exactly_its_own_links_behind(sessions):
    first, second = sessions
    stamp = time.time_ns()
    hand = RRBOT.links[-1]
    upper_arm = next(joint.child for joint in RRBOT.joints if joint.name == SHOULDER)
    with shoulder_and_elbow(first, second) as (lower, upper), TransformListener(second, "r1") as listener:
        for publisher in (lower, upper):
            publisher.publish([0.5], stamp=stamp)
        listener.buffer.wait("world", hand, stamp, timeout_s=DEADLINE_S)
        # Samples may overtake the token that names their writer, and a closed writer has none.
        until(lambda: any("wrist.py" in (frame.writer or "") for frame in listener.buffer.frames()))
        upper.close()
        lower.publish([0.5], stamp=stamp + 50 * MS)
        listener.buffer.wait("world", upper_arm, stamp + 50 * MS, timeout_s=DEADLINE_S)
        listener.buffer.lookup("world", hand, stamp)  # its samples stay
        with pytest.raises(InFuture, match=r"wrist\.py") as raised:
            listener.buffer.lookup("world", hand, stamp + 50 * MS)
        assert raised.value.newest == stamp
        elbow = next(joint for joint in RRBOT.joints if joint.name == ELBOW)
        assert raised.value.edge == (f"r1/{elbow.parent}", f"r1/{elbow.child}")


def test_joint_without_a_driver_has_no_data(sessions):
    first, second = sessions
    with (
        described(first),
        PartialStatePublisher(first, RRBOT, [SHOULDER], "r1") as lower,
        TransformListener(second, "r1") as listener,
    ):
        lower.publish([0.5])
        listener.buffer.wait("base", "upper", timeout_s=DEADLINE_S)  # received live, or as history
        with pytest.raises(NoData):
            listener.buffer.lookup("world", RRBOT.links[-1])


def test_mimic_joints_follow_the_driver_of_their_master(sessions):
    first, second = sessions
    stamp = time.time_ns()
    with (
        described(first, FINGERS, "hand"),
        PartialStatePublisher(first, FINGERS, ["open"], "hand") as gripper,
        PartialStatePublisher(second, FINGERS, ["turn"], "hand") as wrist,
        TransformListener(second, "hand") as listener,
    ):
        wrist.publish([0.0], stamp=stamp)
        gripper.publish([0.04], [0.5], stamp=stamp)
        found = listener.buffer.wait("palm", "right", stamp, timeout_s=DEADLINE_S)
        assert found.translation == pytest.approx([0.0, -0.04, 0.0])
        listener.buffer.wait("wrist", "right", stamp, timeout_s=DEADLINE_S)
        samples = listener.buffer.joint_states("hand")
        assert samples.stamps.tolist() == [stamp]
        assert samples.positions.tolist() == [[0.0, 0.04]]
        assert samples.velocities is not None
        np.testing.assert_array_equal(samples.velocities, [[np.nan, 0.5]])


def test_late_listener_gets_the_parts_of_the_last_seconds(sessions):
    first, second = sessions
    stamp = time.time_ns()
    with shoulder_and_elbow(first, first) as (lower, upper):
        for step in range(300):  # more than a page
            lower.publish([0.001 * step], stamp=stamp + step * MS)
            upper.publish([-0.001 * step], stamp=stamp + step * MS)
        with TransformListener(second, "r1") as late:
            until(lambda: late.stats.recalled + late.stats.received == 600)
            positions, valid = late.buffer.joint_positions_many("r1", stamp + MS * np.arange(300))
    assert valid.all()
    assert positions == pytest.approx(np.outer(np.arange(300), [0.001, -0.001]))


def test_second_driver_of_a_joint_is_refused_with_both_names(sessions):
    first, second = sessions
    with PartialStatePublisher(first, RRBOT, [ELBOW], "r1", program="gripper.py"):
        until(lambda: any("partial_joint_states" in dict(info.writers) for info in discover(second)))
        with pytest.raises(SecondWriter, match=SECOND_DRIVER):
            PartialStatePublisher(second, RRBOT, [SHOULDER, ELBOW], "r1", program="both.py")


@pytest.mark.parametrize("joints", [[ELBOW], [SHOULDER, ELBOW]])
def test_later_of_two_drivers_that_missed_each_other_ends_once_the_first_publishes(
    sessions, monkeypatch, joints
):
    def missed(*_: object) -> frozenset[str]:
        return frozenset()

    with PartialStatePublisher(sessions[0], RRBOT, [ELBOW], "r1", program="gripper.py") as first:
        with monkeypatch.context() as at_once:  # the tokens of the first are on the way
            at_once.setattr("zstate.net.ownership.confirmed_tokens", missed)
            at_once.setattr("zstate.net.edge_ownership.confirmed_tokens", missed)
            second = PartialStatePublisher(sessions[1], RRBOT, joints, "r1", program="both.py")
        with second:
            with pytest.raises(SecondWriter, match=SECOND_DRIVER):
                until(lambda: first.publish([0.0]) or second.publish([0.0] * len(joints)))
            first.publish([0.0])
            with pytest.raises(SecondWriter, match=SECOND_DRIVER):
                second.publish([0.0] * len(joints))


def test_all_joints_and_some_joints_exclude_each_other(sessions):
    first, second = sessions
    with PartialStatePublisher(first, RRBOT, [ELBOW], "r1", program="gripper.py"):
        until(lambda: any("partial_joint_states" in dict(info.writers) for info in discover(second)))
        with pytest.raises(SecondWriter, match=r"gripper\.py"):
            StatePublisher(second, RRBOT, "r1")
        with StatePublisher(second, RRBOT, "r1", streams=("robot_description", "tf_static")):
            pass  # the model is no joint state
    with (
        StatePublisher(first, RRBOT, "r1", program="robot.py"),
        pytest.raises(SecondWriter, match=r"robot\.py.* already writes joint_states of 'r1'"),
    ):
        until(lambda: any("joint_states" in dict(info.writers) for info in discover(second)))
        PartialStatePublisher(second, RRBOT, [ELBOW], "r1")


def test_transform_of_a_link_that_a_driver_moves_is_refused(sessions):
    first, second = sessions
    elbow = next(joint for joint in RRBOT.joints if joint.name == ELBOW)
    with (
        PartialStatePublisher(first, RRBOT, [ELBOW], "r1", program="gripper.py"),
        TransformPublisher(second, "r1") as tracker,
        pytest.raises(SecondWriter, match=r"gripper\.py"),
    ):
        pose = Transform(elbow.parent, elbow.child, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        # It is refused once the token of the driver has arrived.
        until(lambda: tracker.publish([pose]))


def test_joint_may_be_claimed_again_once_its_driver_has_closed(sessions):
    first, second = sessions
    stamp = time.time_ns()
    with (
        described(first),
        TransformListener(first, "r1") as listener,
        PartialStatePublisher(first, RRBOT, [SHOULDER], "r1") as lower,
    ):
        lower.publish([0.0], stamp=stamp)
        for step, session in enumerate((first, second)):
            with PartialStatePublisher(session, RRBOT, [ELBOW], "r1") as upper:
                upper.publish([0.1 * step], stamp=stamp - step * MS)
                # The second driver's samples are another epoch: older ones are no mistake.
                until(lambda step=step: newest_stamps(listener).count(stamp - step * MS) == 2 - step)
        assert listener.buffer.joint_states("r1").joint_names == RRBOT.joint_names


def newest_stamps(listener: TransformListener) -> list[int | None]:
    return [frame.newest for frame in listener.buffer.frames()]


@pytest.mark.parametrize(
    ("joints", "reason"),
    [
        (["elbw"], "unknown joint 'elbw'; did you mean 'elbow'"),
        ([], "none is given"),
        ([ELBOW, ELBOW], f"'{ELBOW}' is given twice"),
    ],
)
def test_joints_that_the_model_does_not_have_are_refused(sessions, joints, reason):
    with pytest.raises(InvalidInput, match=reason):
        PartialStatePublisher(sessions[0], RRBOT, joints, "r1")


def test_wrong_numbers_are_refused_counted_and_not_sent(sessions):
    with PartialStatePublisher(sessions[0], RRBOT, [ELBOW], "r1") as upper:
        with pytest.raises(InvalidInput, match="takes 1 positions"):
            upper.publish([0.0, 1.0])
        with pytest.raises(InvalidInput, match=f"unknown joint '{SHOULDER}'"):
            upper.publish({ELBOW: 0.0, SHOULDER: 0.0})
        assert (upper.stats.sent, upper.stats.refused) == (0, 2)
    with pytest.raises(Closed):
        upper.publish([0.0])


def test_drivers_are_announced_with_their_names(sessions):
    first, second = sessions
    with PartialStatePublisher(first, RRBOT, [ELBOW], "r1", writer="gripper"):
        (info,) = discover(second)
        assert [name for name, _ in info.named("partial_joint_states")] == ["gripper"]
