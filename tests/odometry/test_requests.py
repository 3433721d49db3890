"""Requests to an odometry node, as their parameters."""

from __future__ import annotations

import pytest
from helpers.base_motion import NOISE, mounted, tilted_mount

from zstate.errors import InvalidInput
from zstate.odometry import BaseEstimator
from zstate.odometry.requests import apply_request


@pytest.mark.parametrize(
    "pose",
    ["", "1,2,3", "1,2,0,0,0,1", "1,2,0,0,0,0,1,0", "nan,2,0,0,0,0,1", "1,inf,0,0,0,0,1", "a,b,c,d,e,f,g"],
)
@pytest.mark.parametrize("action", ["reset", "set_pose"])
def test_a_pose_is_seven_finite_numbers(action: str, pose: str):
    base = BaseEstimator(
        odom="odom", base="base_link", imu="imu_link", buffer=mounted(tilted_mount()), imu_noise=NOISE
    )
    with pytest.raises(InvalidInput, match="a pose is seven finite numbers, x,y,z,qx,qy,qz,qw; got"):
        apply_request(base, {"do": action, "pose": pose})
