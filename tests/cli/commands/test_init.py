from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from helpers.cli_runner import RRBOT, Spawn, failure, interrupted, run_cli, started


@pytest.mark.processes
def test_up_runs_the_file_that_init_writes(spawn: Spawn, tmp_path: Path):
    file = tmp_path / "cell.toml"
    written = run_cli("init", "rrbot", "-o", str(file))
    assert written.code == 0
    assert f"`zstate up {file}`" in written.stderr
    child = started(spawn, "up", str(file))
    assert "publishing 'rrbot'" in child.line()
    interrupted(child)


def test_every_example_is_valid_once_uncommented(tmp_path: Path):
    file = tmp_path / "cell.toml"
    run_cli("init", "rrbot", "-o", str(file))
    file.write_text(re.sub(r"^#(?! )", "", file.read_text(), flags=re.MULTILINE))
    calibration = "parameters: {eye_on_hand: true, robot_effector_frame: lower, tracking_base_frame: eye}"
    (tmp_path / "handeye.yaml").write_text(
        f"{calibration}\ntransformation: {{x: 0, y: 0, z: 0, qx: 0, qy: 0, qz: 0, qw: 1}}\n"
    )
    (tmp_path / "hall.yaml").touch()
    shown = run_cli("up", str(file), "--check")
    assert [line.split()[0] for line in shown.stdout.splitlines()] == [
        "router",
        "rrbot",
        "static",
        "hall/map",
        "rrbot/scan",
        "driver",
    ], shown.stderr


def test_the_model_path_is_relative_to_the_file(tmp_path: Path):
    (tmp_path / "urdf").mkdir()
    shutil.copy(RRBOT, tmp_path / "urdf" / "my arm.urdf")
    file = tmp_path / "cell.toml"
    run_cli("init", str(tmp_path / "urdf" / "my arm.urdf"), "-o", str(file), "--name", "arm")
    assert 'model = "urdf/my arm.urdf"' in file.read_text()
    assert run_cli("up", str(file), "--check").stdout.startswith("arm ")


def test_it_lists_the_joints_in_the_order_of_their_positions():
    lines = run_cli("init", "-o", "-").stdout.splitlines()
    at = next(number for number, line in enumerate(lines) if "in the order of their positions" in line)
    assert [line.split()[1] for line in lines[at + 1 : at + 3]] == ["shoulder", "elbow"]


def test_a_file_that_exists_is_kept_unless_forced(tmp_path: Path):
    file = tmp_path / "cell.toml"
    file.write_text("mine")
    assert "--force replaces it" in failure("init", "rrbot", "-o", str(file))
    assert file.read_text() == "mine"
    assert run_cli("init", "rrbot", "-o", str(file), "--force").code == 0


def test_missing_folder_error_names_the_reason(tmp_path: Path):
    assert "cannot be written: No such file" in failure(
        "init", "rrbot", "-o", str(tmp_path / "gone" / "a.toml")
    )
