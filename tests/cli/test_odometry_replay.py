"""The report and the figure of replayed odometry; commands/test_odometry.py replays recordings."""

from __future__ import annotations

import pytest

from zstate import Transform, TransformBuffer
from zstate.cli.odometry_replay import ReplayedOdometry, odometry_figure, report_lines
from zstate.odometry import BaseEstimator, ImuNoise

Points = list[tuple[float, float, float, float]]
BAND = 2.67, 3.35


def replayed(nis: dict[str, Points]) -> ReplayedOdometry:
    """20 s at the origin, with the mean NIS of sources."""
    mounts = TransformBuffer()
    mounts.insert_static(Transform("base", "imu", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0)))
    noise = ImuNoise(gyro=1e-3, accel=2e-2, gyro_bias=2e-5, accel_bias=1e-3)
    base = BaseEstimator(odom="odom", base="base", imu="imu", buffer=mounts, imu_noise=noise)
    for tenth in range(200):
        base.imu(tenth * 100_000_000, [0.0, 0.0, 0.0], [0.0, 0.0, 9.80665])
    return ReplayedOdometry("base", [base.state(19_000_000_000), base.state()], (), nis)


@pytest.mark.parametrize(
    ("standstill", "found"),
    [
        ({}, "no rest at the start: it was never found to stand"),
        (
            {"standstill": [(12.3, 6.0, *BAND)]},
            "no rest at the start: it was first found to stand after 12.3 s",
        ),
        ({"standstill": [(0.5, 6.0, *BAND)]}, None),
    ],
)
def test_report_explains_a_large_sigma_of_the_yaw(standstill: dict[str, Points], found: str | None):
    _, *explanations = report_lines(replayed(standstill))
    assert [text.partition(", so ")[0] for text in explanations] == ([] if found is None else [found])
    assert all("begin a recording with 3 s at rest" in text for text in explanations)


@pytest.mark.parametrize(
    ("least", "labels"), [(0.13, "0.1 0.2 0.5 1 2 5"), (1e-4, "0.0001 0.001 0.01 0.1 1")]
)
def test_labels_of_the_nis_are_plain_numbers_with_room_between_them(least: float, labels: str):
    figure = odometry_figure(replayed({"wheels": [(0.0, least, *BAND), (15.0, 1.0, *BAND)]}), "r1")
    axis = figure.axes[1].yaxis
    low, high = axis.get_view_interval()
    ticks = sorted([*axis.get_majorticklocs(), *axis.get_minorticklocs()])
    shown = {tick: axis.get_major_formatter()(tick) for tick in ticks if low <= tick <= high}
    assert " ".join(shown.values()) == labels
