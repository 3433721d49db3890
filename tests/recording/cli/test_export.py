from __future__ import annotations

from pathlib import Path

import pytest
from helpers.cli_runner import failure, run_cli
from helpers.recording_builder import MS, START, RecordingBuilder, pose, swing_positions, swing_velocities


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """ "arm" for 1 s at 100 Hz, of which the first 10 samples have no pose in "map"."""
    path = tmp_path / "run.mcap"
    with RecordingBuilder(path) as builder:
        builder.describe("arm")
        for n in range(101):
            builder.joints("arm", START + n * 10 * MS, swing_positions(n), swing_velocities(n))
            if n >= 10:
                builder.edges("arm", START + n * 10 * MS, {("map", "arm/world"): pose(n)})
    return path


def test_table_stands_next_to_the_recording_with_a_summary(run: Path):
    output = run_cli("export", str(run), "--csv").stdout
    table = run.with_suffix(".csv")
    assert output.startswith("exported 101 rows of arm over 1.000 s in ")
    assert f"into {table} (" in output
    assert output.endswith("): position and velocity of 2 joints; nothing missing\n")
    names, *rows = table.read_text().splitlines()
    assert names == "stamp,position.shoulder,position.elbow,velocity.shoulder,velocity.elbow"
    assert len(rows) == 101
    assert rows[1] == ",".join(map(str, [START + 10 * MS, *swing_positions(1), *swing_velocities(1)]))


def test_rows_without_a_pose_or_joints_are_counted(run: Path, tmp_path: Path):
    stamps = tmp_path / "stamps.txt"
    stamps.write_text("\n".join(str(START + n * 10 * MS) for n in (5, 50, 500)))
    arguments = ("--stamps", str(stamps), "--pose", "map", "arm/tool", "--parquet")
    pytest.importorskip("pyarrow", reason="pip install 'zstate[export]'")
    output = run_cli("export", str(run), *arguments, "--output", str(tmp_path / "o.parquet")).stdout
    assert "position of 2 joints, 1 pose; " in output
    assert "2 rows without 'arm/tool' in 'map', 1 row without interpolated joints" in output


def test_existing_table_is_kept_without_overwrite(run: Path):
    run.with_suffix(".csv").write_text("precious")
    message = failure("export", str(run), "--csv")
    assert "exists" in message
    assert "--overwrite" in message
    assert run.with_suffix(".csv").read_text() == "precious"
    assert run_cli("export", str(run), "--csv", "--overwrite", "--rate", "10").code == 0
    assert len(run.with_suffix(".csv").read_text().splitlines()) == 1 + 11


def test_wrong_usage_is_explained(run: Path, tmp_path: Path):
    stamps = tmp_path / "stamps.txt"
    stamps.write_text(f"{START}\n1.5\n")
    assert "'--csv' or '--parquet'" in failure("export", str(run), code=2)
    assert "line 2" in failure("export", str(run), "--csv", "--stamps", str(stamps), code=2)
    stamps.write_text(f"{START}\n")
    both = ("--rate", "10", "--stamps", str(stamps))
    assert "exclude each other" in failure("export", str(run), "--csv", *both, code=2)
    assert "joint_states of 'leg'; it has those of 'arm'" in failure(
        "export", str(run), "leg", "--csv", "--pose", "map", "arm/tool"
    )
    assert "'arm/tol'" in failure("export", str(run), "--csv", "--pose", "map", "arm/tol")
    assert not run.with_suffix(".csv").exists()
