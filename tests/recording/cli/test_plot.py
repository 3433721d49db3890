from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers.cli_runner import RRBOT, failure, missing_library, published_robot, run_cli
from helpers.recording_builder import START, RecordingBuilder

from zstate import StaticPublisher, Transform, TransformBuffer, connect, load_model
from zstate.errors import InvalidInput
from zstate.recording.cli.plot import joint_series, path_series
from zstate.scans.messages import OccupancyGrid
from zstate.wire.messages import to_block

SECOND = 1_000_000_000
DOCUMENTS = [
    {"stamp": SECOND, "seq": 1, "positions": {"slide": 0.25, "turn": 1.0, "flight": [1.0, 2.0]}},
    {"stamp": 0, "seq": 0, "positions": {"slide": 0.5, "turn": 3.0, "flight": [4.0, 5.0]}},
]
MODEL = """
<robot name="r"> <link name="a"/> <link name="b"/> <link name="c"/>
  <joint name="slide" type="prismatic"> <parent link="a"/> <child link="b"/> <axis xyz="1 0 0"/>
    <limit lower="0" upper="1" velocity="1" effort="1"/> </joint>
  <joint name="turn" type="continuous"> <parent link="b"/> <child link="c"/> <axis xyz="0 0 1"/> </joint>
</robot>
"""


def needs_matplotlib() -> None:
    pytest.importorskip("matplotlib", reason="pip install 'zstate[plot]'")


def texts(file: Path) -> str:
    """The texts of a picture, which Matplotlib writes as comments next to the outlines of the letters."""
    ElementTree.parse(file)
    return file.read_text()


def test_positions_become_curves_in_the_order_of_time_with_the_units_of_their_joints():
    curves = joint_series(DOCUMENTS, load_model(MODEL))
    assert curves.names == ("slide", "turn", "flight.0", "flight.1")
    assert curves.units == ("m", "rad", "", "")
    assert curves.seconds.tolist() == [0.0, 1.0]
    assert curves.values.tolist() == [[0.5, 3.0, 4.0, 5.0], [0.25, 1.0, 1.0, 2.0]]
    assert curves.select(["turn", "flight"]).names == ("turn", "flight.0", "flight.1")
    assert curves.with_unit("m").values.tolist() == [[0.5], [0.25]]


def test_unknown_joint_is_refused_with_the_known_ones():
    curves = joint_series(DOCUMENTS, None)
    with pytest.raises(InvalidInput, match=r"did you mean 'slide'.*joints: slide, turn"):
        curves.select(["slid"])


def circling() -> TransformBuffer:
    """A car that drives round a circle of radius 2 m, in 4 s."""
    buffer = TransformBuffer()
    for stamp in range(0, 4 * SECOND + 1, SECOND // 50):
        angle = stamp / SECOND * math.pi / 2
        place = (2.0 * math.cos(angle), 2.0 * math.sin(angle), 0.0)
        buffer.insert(Transform("map", "car", place, (0.0, 0.0, 0.0, 1.0), stamp))
    return buffer


def test_path_is_sampled_evenly_over_its_history():
    curves = path_series(circling(), "map", "car")
    assert (curves.stamps[0], curves.stamps[-1]) == (0, 4 * SECOND)
    assert np.hypot(curves.values[:, 0], curves.values[:, 1]) == pytest.approx(2.0, abs=1e-3)
    part = path_series(circling(), "map", "car", start_s=1.0, seconds=2.0)
    assert (part.stamps[0], part.stamps[-1]) == (SECOND, 3 * SECOND)
    with pytest.raises(InvalidInput, match=r"covers 4\.000 s; nothing is left after the first 9 s"):
        path_series(circling(), "map", "car", start_s=9.0)


def test_live_joint_states_are_drawn(tmp_path: Path):
    needs_matplotlib()
    file = tmp_path / "joints.svg"
    with published_robot():
        ended = run_cli("plot", "--seconds", "0.5", "--output", str(file))
    assert ended.code == 0, ended.stderr
    assert ended.stdout.startswith(f"wrote {file}: 2 curves, ")
    assert all(name in texts(file) for name in ("rrbot: joint positions", "shoulder", "elbow", "[rad]"))


def test_the_path_of_a_frame_is_drawn(tmp_path: Path):
    needs_matplotlib()
    file = tmp_path / "path.png"
    with published_robot():
        ended = run_cli("plot", "--path", "base", "tool", "--seconds", "0.5", "--output", str(file))
    assert ended.code == 0, ended.stderr
    assert file.read_bytes().startswith(b"\x89PNG")


def test_a_recording_is_drawn_whole_or_in_part(tmp_path: Path):
    needs_matplotlib()
    recording, joints, path = (tmp_path / name for name in ("run.mcap", "joints.svg", "path.svg"))
    with published_robot():
        assert run_cli("record", str(recording), "--seconds", "1.5").code == 0
    ended = run_cli("plot", "--file", str(recording), "--joint", "elbow", "--output", str(joints))
    assert "1 curve, " in ended.stdout, ended.stderr
    assert "shoulder" not in texts(joints)
    options = ("--path", "base", "tool", "--start", "0.5", "--seconds", "0.5", "--output", str(path))
    ended = run_cli("plot", "rrbot", "--file", str(recording), *options)
    assert "in 0.5 s" in ended.stdout, ended.stderr
    message = failure("plot", "--file", str(recording), "--start", "60")
    assert "no joint state of 'rrbot' in that time" in message
    assert "no robot" not in message
    assert "its robots: 'rrbot'" in failure("plot", "panda", "--file", str(recording))


def test_only_robot_with_joint_states_is_drawn_by_default(tmp_path: Path):
    needs_matplotlib()
    path = tmp_path / "r.mcap"
    hall = OccupancyGrid(4, START, "map", 0.5, 1, 1, to_block([0, 0, 0, 0, 0, 0, 1]), b"\0")
    with RecordingBuilder(path) as builder:
        builder.describe("rrbot")
        for n in range(2):
            builder.joints("rrbot", START + n * SECOND, [0.25, 0.5])
        builder.edges("cart", START, {("odom", "base"): [0, 0, 0, 0, 0, 0, 1]})
        builder.encoder.write_message("hall", hall, START, "floor")
    ended = run_cli("plot", "--file", str(path), "--output", str(tmp_path / "joints.svg"))
    assert "2 curves, " in ended.stdout, ended.stderr


def test_mistakes_are_reported(tmp_path: Path):
    needs_matplotlib()
    assert ".png, .svg, .pdf" in failure("plot", "rrbot", "--output", "plot.jpg", code=2)
    assert "they are different plots" in failure("plot", "--joint", "a", "--path", "a", "b", code=2)
    assert "--start, --at, --from and --to need --file RECORDING" in failure(
        "plot", "rrbot", "--start", "1", code=2
    )
    assert "a duration is" in failure("plot", "--file", "x.mcap", "--start", "nan", code=2)
    assert "no robot is announced" in failure("plot")
    with published_robot("left"), published_robot("right"):
        assert "which robot? announced: 'left', 'right'" in failure("plot")
        nowhere = tmp_path / "nowhere" / "plot.png"
        assert "cannot write" in failure("plot", "left", "--seconds", "0.2", "--output", str(nowhere))
    with connect() as session, StaticPublisher(session, "cell") as statics:
        statics.set(Transform("floor", "table", (0.0, 0.0, 0.7), (0.0, 0.0, 0.0, 1.0)))
        assert "static" in failure("plot", "--path", "floor", "table", "--seconds", "0.2")


def test_missing_matplotlib_is_reported_with_the_package_to_install():
    with missing_library("matplotlib"):
        assert "pip install 'zstate[plot]'" in failure("plot", RRBOT)
