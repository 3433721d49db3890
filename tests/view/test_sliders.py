"""Sliders: moved by hand, published at an exact rate, and never against somebody else."""

from __future__ import annotations

import math
import os

import numpy as np
import pytest
from helpers.processes import SOON_S, until
from helpers.robots import RRBOT, SampleCollector

from zstate.errors import InvalidInput
from zstate.model.urdf import parse_urdf
from zstate.net.presence import discover
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.view.sliders import SliderPublisher
from zstate.wire.messages import from_block

ARM = parse_urdf(
    """<robot name="arm"><link name="base"/><link name="upper"/><link name="left"/><link name="right"/>
    <joint name="bent" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
      <limit lower="0.5" upper="1.5" velocity="1" effort="1"/></joint>
    <joint name="finger" type="prismatic"><parent link="upper"/><child link="left"/><axis xyz="0 1 0"/>
      <limit lower="-0.04" upper="0.04" velocity="1" effort="1"/></joint>
    <joint name="other" type="prismatic"><parent link="upper"/><child link="right"/><axis xyz="0 1 0"/>
      <limit lower="-1" upper="1" velocity="1" effort="1"/>
      <mimic joint="finger" multiplier="-2" offset="0.1"/></joint></robot>""",
    "arm.urdf",
)


@pytest.fixture
def arm(sessions):
    with SliderPublisher(sessions[0], ARM, "arm1", rate_hz=200.0) as sliders:
        yield sliders


def test_they_begin_at_zero_or_where_zero_is_out_of_reach_in_the_middle(arm):
    assert arm.positions.tolist() == [1.0, 0.0]


def test_a_dial_that_is_turned_is_what_is_published(arm, sessions):
    tap = SampleCollector(sessions[1], "zstate/arm1/joint_states")
    arm.set("bent", 1.25)
    until(lambda: any(from_block(state.positions)[0] == 1.25 for state in tap.joint_states(1)))
    tap.close()


def test_a_follower_sees_the_link_move_and_the_mimic_with_it(arm, sessions):
    with TransformListener(sessions[1], "arm1") as listener:
        listener.buffer.wait("base", "left", timeout_s=SOON_S)
        arm.set("finger", 0.03)

        def follows() -> bool:
            left = listener.buffer.lookup("upper", "left").translation[1]
            right = listener.buffer.lookup("upper", "right").translation[1]
            return math.isclose(left, 0.03) and math.isclose(right, 0.1 - 2 * 0.03)

        until(follows)
    assert arm.mimics == {"other": pytest.approx(0.1 - 2 * 0.03)}


def test_zero_is_the_nearest_limit_where_zero_is_out_of_reach(arm):
    arm.set("finger", 0.02)
    arm.zero()
    assert arm.positions.tolist() == [0.5, 0.0]
    arm.home()
    assert arm.positions.tolist() == [1.0, 0.0]


def test_random_positions_are_within_the_limits(arm):
    generator = np.random.default_rng(1)
    for _ in range(50):
        arm.random(generator)
        assert (arm.dials.lower <= arm.values).all()
        assert (arm.values <= arm.dials.upper).all()


def test_a_sine_moves_all_joints_until_one_is_turned_by_hand(arm):
    arm.is_swinging = True
    before = arm.values
    until(lambda: not np.isclose(arm.values, before).any())
    arm.set("finger", 0.01)
    assert not arm.is_swinging
    bent = arm.values[0]
    arm.read(0)
    assert arm.values.tolist() == [bent, 0.01]


def test_beyond_the_limits_nothing_moves_and_the_limits_are_said(arm):
    with pytest.raises(InvalidInput, match=r"'bent' takes 0.5 to 1.5 rad, not 2"):
        arm.set("bent", 2.0)
    with pytest.raises(InvalidInput, match="did you mean 'finger'"):
        arm.set("fingr", 0.0)
    assert arm.positions.tolist() == [1.0, 0.0]


def test_another_rate_is_kept_from_then_on(arm):
    arm.rate_hz = 50.0
    until(lambda: arm.achieved_hz is not None and 49.0 < arm.achieved_hz < 51.0)
    with pytest.raises(InvalidInput, match="a rate is above 0"):
        arm.rate_hz = 0.0
    assert arm.rate_hz == 50.0


def test_where_somebody_else_writes_the_joints_nothing_is_published_and_it_is_said_who(sessions):
    with StatePublisher(sessions[1], RRBOT, "r1", program="driver") as driver:
        driver.publish([0.0, 0.0])
        until(lambda: discover(sessions[0], 0.2))
        with SliderPublisher(sessions[0], RRBOT, "r1") as sliders:
            until(lambda: sliders.refusal)
            assert sliders.achieved_hz is None
            assert f"pid {os.getpid()}" in sliders.refusal
            assert "driver@" in sliders.refusal
            assert "joint_states of 'r1'" in sliders.refusal
            assert not sliders.open()
            driver.close()
            until(sliders.open)
            assert sliders.refusal == ""
            until(lambda: sliders.achieved_hz)


def test_they_move_the_joints_of_a_robot_whose_model_another_program_tells(sessions):
    streams = ("robot_description", "tf_static", "tf")
    with StatePublisher(sessions[1], RRBOT, "r1", streams=streams, program="model"):
        until(lambda: discover(sessions[0], 0.2))
        with SliderPublisher(sessions[0], RRBOT, "r1") as sliders:
            assert sliders.refusal == ""
            (robot,) = discover(sessions[1])
            writers = {(stream, writer.program) for stream, writer in robot.writers}
            mine = {stream for stream, program in writers if program != "model"}
            assert mine == {"joint_states"}


def test_closed_sliders_are_gone_from_the_network_and_do_not_open_again(sessions):
    sliders = SliderPublisher(sessions[0], RRBOT, "r1")
    sliders.close()
    sliders.close()
    until(lambda: not discover(sessions[1], 0.2))
    assert not sliders.open()
