"""The models in a recording, and whether its joint states fit them."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.recording_builder import MS, RRBOT, START, Bag, RecordingBuilder, swing_positions

from zstate.model.robot import RobotModel
from zstate.recording.decode import DecodedRecording, first_descriptions, recorded_model
from zstate.recording.reader import RecordingReader


def models(
    path: Path, robots: tuple[str, ...] | None = None
) -> tuple[dict[str, RobotModel | None], list[str]]:
    refused: list[str] = []

    def refuse(reason: str, _: str) -> None:
        refused.append(reason)

    with RecordingReader(path) as reader:
        transcript = DecodedRecording(reader, refuse)
        described = first_descriptions(transcript, robots)
        found = {
            robot: recorded_model(transcript, description, refuse) for robot, description in described.items()
        }
    return found, refused


def test_described_robot_with_recorded_joints_has_a_model(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        for robot in ("r1", "r2"):
            builder.describe(robot)
            builder.joints(robot, START, swing_positions(0))
    found, refused = models(tmp_path / "r.mcap")
    assert {robot: model and model.digest for robot, model in found.items()} == {
        "r1": RRBOT.digest,
        "r2": RRBOT.digest,
    }
    assert set(models(tmp_path / "r.mcap", ("r2",))[0]) == {"r2"}
    assert not refused


def test_description_without_joint_states_gives_no_model(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
    assert models(tmp_path / "r.mcap") == ({"arm": None}, [])


@pytest.mark.parametrize("last", [{"shoulder": 0.5, "elbow": 0.5}, {"elbow": 0.5}])
@pytest.mark.parametrize(("after", "is_found"), [(99, True), (100, False)])
def test_first_joint_states_together_must_have_all_joints(
    tmp_path: Path, after: int, is_found: bool, last: dict[str, float], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("zstate.recording.decode._MAX_TRIED", 100)
    with Bag(tmp_path / "bag") as bag:
        bag.describe()
        for n in range(after):
            bag.joints(START + n * MS, {"shoulder": 0.5})
        bag.joints(START + after * MS, last)
    found, _ = models(tmp_path / "bag")
    assert (found["ros"] is not None) == is_found


def test_drivers_of_a_recording_need_not_have_all_joints(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        builder.part("arm", START, {"elbow": 0.5}, "wrist", session=4)
    found, _ = models(tmp_path / "r.mcap")
    assert found["arm"] is not None


def test_invalid_urdf_is_reported(tmp_path: Path):
    with Bag(tmp_path / "bag") as bag:
        bag.describe(urdf="hello")
        bag.joints(START, {"shoulder": 0.5})
    assert models(tmp_path / "bag") == ({"ros": None}, ["robot description"])
