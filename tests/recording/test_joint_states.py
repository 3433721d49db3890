"""The joint states of a recording as arrays are those that its buffer keeps."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from helpers.recording_builder import (
    MS,
    RRBOT,
    START,
    Bag,
    RecordingBuilder,
    S,
    swing_positions,
    swing_velocities,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from zstate import load_model
from zstate.errors import InvalidInput
from zstate.model.joint_history import JointHistory
from zstate.recording.recording import Recording
from zstate.wire.messages import JointState, order_digest, to_block


def joint_states(path: Path, robot: str | None = None) -> JointHistory:
    with Recording(path) as recording:
        return recording.joint_states(robot)


def test_arrays_are_the_recorded_numbers_at_their_stamps(tmp_path: Path):
    stamps = [START + n * 10 * MS for n in range(10_000)]
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        builder.describe("arm")
        for n, stamp in enumerate(stamps):
            builder.joints("arm", stamp, swing_positions(n / 100), swing_velocities(n / 100))
    states = joint_states(tmp_path / "r.mcap")
    assert states.joint_names == states.coordinates == states.velocity_coordinates == RRBOT.joint_names
    assert states.stamps.tolist() == stamps
    assert states.positions.tolist() == [swing_positions(n / 100) for n in range(10_000)]
    assert states.velocities is not None
    assert states.velocities.tolist() == [swing_velocities(n / 100) for n in range(10_000)]
    assert states.efforts is None


# Steps between the stamps of samples [ns], and whether the writer changes.
STEPS = st.lists(
    st.tuples(
        st.sampled_from([10 * MS, 10 * MS, 10 * MS, 0, -5 * MS, -150 * MS, -2 * S, -11 * S, 12 * S]),
        st.sampled_from([0, 0, 0, 0, 0, 1, -1]),
    ),
    min_size=1,
    max_size=40,
)


@settings(max_examples=200, deadline=None)
@given(STEPS)
@pytest.mark.long
def test_samples_are_those_of_the_buffer_whatever_clocks_and_writers_do(tmp_path_factory, steps):
    path = tmp_path_factory.mktemp("steps") / "r.mcap"
    stamp, session = START + 100 * S, 5
    with RecordingBuilder(path) as builder:
        builder.describe("arm", session=session)
        for n, (step, change) in enumerate(steps):
            stamp, session = stamp + step, session + change
            builder.joints("arm", stamp, [n, -n], session=session, log_time=START + n * MS)
    with Recording(path) as recording:
        kept, states = recording.buffer().joint_states("arm"), recording.joint_states()
    assert states.stamps.tolist() == kept.stamps.tolist()
    assert states.positions.tolist() == kept.positions.tolist()


def test_another_model_begins_a_new_history_with_its_joints(tmp_path: Path):
    gripper = load_model("gripper")
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        builder.describe("arm")
        for n in range(5):
            builder.joints("arm", START + n * MS, swing_positions(n))
        builder.describe("arm", gripper, at=START + S)
        closed = [0.01] * gripper.position_count
        for n in range(3):
            builder.joints("arm", START + S + n * MS, closed, model=gripper)
    states = joint_states(tmp_path / "r.mcap")
    assert states.joint_names == gripper.joint_names
    assert states.stamps.tolist() == [START + S + n * MS for n in range(3)]
    assert states.positions.tolist() == [closed] * 3


def test_efforts_are_kept_and_nan_in_rows_without_them(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        builder.describe("arm")
        for n in range(6):
            efforts = None if n < 3 else to_block([n, 0.5])
            digest = order_digest(RRBOT.joint_names)
            state = JointState(START + n * MS, n, 1, digest, to_block([n, n]), None, efforts)
            builder.encoder.write_message("arm", state, START + n * MS)
    states = joint_states(tmp_path / "r.mcap")
    assert states.velocities is None
    assert states.efforts is not None
    assert np.isnan(states.efforts[:3]).all()
    assert states.efforts[3:].tolist() == [[3.0, 0.5], [4.0, 0.5], [5.0, 0.5]]


def test_efforts_of_a_part_in_the_middle_are_kept_at_their_rows(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        builder.describe("arm")
        digest = order_digest(RRBOT.joint_names)
        for n in range(6_000):
            efforts = to_block([n, -n]) if 2_000 <= n < 2_500 else None
            state = JointState(START + n * 20 * MS, n, 1, digest, to_block([n, n]), None, efforts)
            builder.encoder.write_message("arm", state, state.stamp)
    states = joint_states(tmp_path / "r.mcap")
    assert states.positions[:, 0].tolist() == list(range(6_000))
    assert states.efforts is not None
    assert np.flatnonzero(~np.isnan(states.efforts).any(axis=1)).tolist() == list(range(2_000, 2_500))
    assert states.efforts[2_000:2_500, 1].tolist() == [-n for n in range(2_000, 2_500)]


def test_messages_of_ros_are_reordered_and_those_that_cannot_be_used_are_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    with Bag(tmp_path / "bag") as bag:
        bag.describe()
        bag.joints(START + 1, {"elbow": 0.25, "lid": 9.0, "shoulder": 0.5})
        bag.joints(START + 2, {"elbow": np.nan, "lid": 9.0, "shoulder": 0.5})
        bag.joints(START + 3, {"shoulder": 0.5})
        bag.joints(START + 4, {"shoulder": 1.5, "elbow": 1.25})
        bag.joints(0, {"shoulder": 1.5, "elbow": 1.25}, log_time=START + 5)
    states = joint_states(tmp_path / "bag")
    assert states.stamps.tolist() == [START + 1, START + 4]
    assert states.positions.tolist() == [[0.5, 0.25], [1.5, 1.25]]
    for reason in ("bad numbers", "missing joints", "no stamp"):
        assert f"recorded joint_states refused ({reason})" in caplog.text


def test_floating_joint_needs_a_quaternion_of_length_one(tmp_path: Path):
    urdf = (
        '<robot name="drone"><link name="world"/><link name="body"/><joint name="fly" type="floating">'
        '<parent link="world"/><child link="body"/></joint></robot>'
    )
    names = [f"fly.{part}" for part in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    with Bag(tmp_path / "bag") as bag:
        bag.describe(urdf=urdf)
        for n, length in enumerate((1.0, 1.0 + 1e-6, 2.0)):
            numbers = [float(n), 0.0, 0.0, 0.0, 0.0, 0.0, length]
            bag.joints(START + n, dict(zip(names, numbers, strict=True)))
    states = joint_states(tmp_path / "bag")
    assert states.coordinates == tuple(names)
    assert states.positions.tolist() == [[0, 0, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 0, 1]]


def test_recording_without_a_model_has_the_joints_of_its_first_message(tmp_path: Path):
    with Bag(tmp_path / "bag") as bag:
        for n in range(3):
            bag.joints(START + n, {"left": float(n), "right": float(-n)}, "/gripper/joint_states")
    states = joint_states(tmp_path / "bag")
    assert states.joint_names == ("left", "right")
    assert states.positions.tolist() == [[0, 0], [1, -1], [2, -2]]


def test_one_of_several_robots_must_be_named(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        for n, robot in enumerate(("left", "right")):
            builder.describe(robot)
            builder.joints(robot, START, [n, n])
    assert joint_states(tmp_path / "r.mcap", "right").positions.tolist() == [[1.0, 1.0]]
    with pytest.raises(InvalidInput, match="'left', 'right'"):
        joint_states(tmp_path / "r.mcap")
    with pytest.raises(InvalidInput, match=r"not hold joint_states of 'middle'.*'left', 'right'"):
        joint_states(tmp_path / "r.mcap", "middle")
    with Recording(tmp_path / "r.mcap", "left") as recording:
        assert recording.joint_states().positions.tolist() == [[0.0, 0.0]]


@pytest.mark.long
def test_parts_ascend_and_take_memory_that_does_not_grow_with_the_recording(tmp_path: Path):
    peaks: list[int] = []
    whole_peaks: list[int] = []
    for count in (20_000, 60_000):
        path = tmp_path / f"{count}.mcap"
        with RecordingBuilder(path) as builder:
            builder.describe("arm")
            for n in range(count):
                late = 5 * MS if n % 1000 == 999 else 0
                log_time = START + n * MS
                builder.joints("arm", log_time - late + n % 2, swing_positions(n), log_time=log_time)
        with Recording(path) as recording:
            tracemalloc.start()
            stamps = [part.trajectory.stamps.copy() for part in recording.joint_state_reader().batches()]
            peaks.append(tracemalloc.get_traced_memory()[1] - sum(part.nbytes for part in stamps))
            tracemalloc.stop()
            tracemalloc.start()
            whole = recording.joint_states()
            whole_peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
        assert len(whole) == sum(map(len, stamps))
        assert (np.diff(np.concatenate(stamps)) > 0).all()
    assert peaks[1] < 1.5 * peaks[0]
    # All samples together take their size and an eighth: stamp and two positions of 40,000 more.
    assert whole_peaks[1] - whole_peaks[0] < 1.5 * 40_000 * 3 * 8
