from __future__ import annotations

from pathlib import Path

import pytest
from helpers.cli_runner import failure, run_cli
from helpers.recording_files import joint_states, write_run

from zstate.recording.info import read_info


@pytest.fixture
def cut(tmp_path: Path) -> Path:
    """A recording that ends in the middle of its second chunk."""
    path = tmp_path / "run.mcap"
    write_run(path, joint_states(100), flush_every=60)
    path.write_bytes(path.read_bytes()[:-3000])
    assert not read_info(path).complete
    return path


def test_recover_reports_savings_and_losses_and_keeps_the_original(cut: Path):
    before = cut.read_bytes()
    output = run_cli("recover", str(cut)).stdout
    saved = cut.with_name("run_recovered.mcap")
    count = read_info(saved).message_count
    assert output.startswith(f"saved {count} messages in ")
    assert f"into {saved} (/robot_description 1, /joint_states {count - 1})" in output
    assert "\nlost " in output
    assert read_info(saved).complete
    assert cut.read_bytes() == before


def test_target_may_be_named_and_an_existing_file_is_kept(cut: Path, tmp_path: Path):
    target = tmp_path / "saved.mcap"
    assert run_cli("recover", str(cut), str(target)).code == 0
    before = target.read_bytes()
    message = failure("recover", str(cut), str(target))
    assert "exists" in message
    assert "--overwrite" in message
    assert target.read_bytes() == before
    assert run_cli("recover", str(cut), str(target), "--overwrite").code == 0


def test_complete_file_is_copied_and_reported_as_complete(tmp_path: Path):
    write_run(tmp_path / "run.mcap", joint_states(10))
    output = run_cli("recover", str(tmp_path / "run.mcap")).stdout
    assert "was complete: nothing to recover" in output


def test_file_without_its_end_has_lost_nothing(tmp_path: Path):
    path = tmp_path / "run.mcap"
    write_run(path, joint_states(10), flush_every=10)
    path.write_bytes(path.read_bytes()[:-8])
    output = run_cli("recover", str(path)).stdout
    assert "saved 11 messages" in output
    assert "nothing lost" in output


def test_file_that_is_not_a_recording_is_refused_without_a_target(tmp_path: Path):
    (tmp_path / "notes.mcap").write_text("hello, this is a note")
    assert "is not a recording" in failure("recover", str(tmp_path / "notes.mcap"))
    assert "No such file" in failure("recover", str(tmp_path / "nothing.mcap"))
    assert [path.name for path in tmp_path.iterdir()] == ["notes.mcap"]
