"""Names with times, and what is deleted of the files that they match."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import pytest
from helpers.recording_files import joint_states, write_run

from zstate.errors import InvalidInput
from zstate.recording.mcap.writer import RecordingWriter
from zstate.recording.retention import FilePattern, Keep, Retention

START = datetime(2026, 3, 5, 7, 8, 9)
DAY_S = 86_400.0


def test_directives_are_the_digits_of_the_start_time():
    digits = {"%Y": "2026", "%y": "26", "%m": "03", "%d": "05", "%H": "07", "%M": "08", "%S": "09"}
    for directive, expected in digits.items():
        assert FilePattern(f"a-{directive}.mcap").path_at(START) == Path(f"a-{expected}.mcap")
    # January has 31 days, February 28.
    assert FilePattern("%j.mcap").path_at(START) == Path(f"{31 + 28 + 5:03d}.mcap")
    assert FilePattern("/data/rec-%Y%m%d-%H%M%S.mcap").path_at(START) == Path(
        "/data/rec-20260305-070809.mcap"
    )


def test_double_percent_is_a_percent_sign_and_no_time():
    pattern = FilePattern("100%%-%%d.mcap")
    assert pattern.path_at(START) == Path("100%-%d.mcap")
    assert not pattern.has_time
    assert FilePattern("100%%-%d.mcap").has_time


@pytest.mark.parametrize("name", ["a%Q", "a%", "a%-d", "a%B", "% d", "%%%"])
def test_other_directives_are_refused_with_the_known_ones(name: str):
    with pytest.raises(InvalidInput, match=r"write %Y, .* %S for parts of the time .* or %% for a percent"):
        FilePattern(f"{name}.mcap")


def test_folder_is_literal():
    assert FilePattern("/data/%Y/a.mcap").path_at(START) == Path("/data/%Y/a.mcap")
    assert not FilePattern("/data/%Y/a.mcap").has_time


def test_only_files_that_match_and_that_zstate_recorded_are_found(tmp_path: Path):
    mine = tmp_path / "rec-20260101.mcap"
    write_run(mine, joint_states(300), max_seconds=1.0)
    for other in ("rec-2026010.mcap", "rec-202601010.mcap", "rec-20260101x.mcap", "my-rec-20260101.mcap"):
        write_run(tmp_path / other, [])
    # A copy of part 1 under the name of part 7, of a first part, and a text.
    part = (tmp_path / "rec-20260101_1.mcap").read_bytes()
    (tmp_path / "rec-20260101_7.mcap").write_bytes(part)
    (tmp_path / "rec-20260102.mcap").write_bytes(part)
    (tmp_path / "rec-20260103.mcap").write_text("notes")
    (tmp_path / "rec-20260104.mcap").symlink_to(mine)
    (tmp_path / "rec-20260105.mcap").mkdir()
    found = FilePattern(str(tmp_path / "rec-%Y%m%d.mcap")).recordings()
    assert {file.path.name for file in found} == {
        *("rec-20260101.mcap", "rec-20260101_1.mcap", "rec-20260101_2.mcap")
    }
    assert all(file.size == file.path.stat().st_size for file in found)


@pytest.mark.parametrize(
    ("text", "max_bytes", "max_age_s"),
    [
        ("50GB", 50e9, None),
        ("1.5 tb", 1.5e12, None),
        ("200kB", 200e3, None),
        ("3MB", 3e6, None),
        ("7d", None, 7 * DAY_S),
        ("36h", None, 36 * 3600.0),
        ("90min", None, 90 * 60.0),
        ("45s", None, 45.0),
    ],
)
def test_sizes_and_ages_have_units(text: str, max_bytes: float | None, max_age_s: float | None):
    keep = Keep.parse(text)
    assert keep.max_bytes == (float("inf") if max_bytes is None else max_bytes)
    assert keep.max_age_s == (float("inf") if max_age_s is None else max_age_s)


@pytest.mark.parametrize("text", ["50", "", "GB", "0GB", "-1d", "1e3MB", "5m", "7 days", "inf d", "1GB 2d"])
def test_other_bounds_are_refused_with_the_units(text: str):
    with pytest.raises(InvalidInput, match=r"kB, MB, GB, TB of files in total, or s, min, h, d since"):
        Keep.parse(text)


@pytest.fixture
def week(tmp_path: Path) -> list[Path]:
    """Recordings that ended 7, 6 ... 1 days ago, all of one size."""
    files = [tmp_path / f"rec-2026010{day}.mcap" for day in range(1, 8)]
    now = time.time()
    for age, file in zip(range(7, 0, -1), files, strict=True):
        write_run(file, joint_states(10))
        os.utime(file, (now, now - age * DAY_S))
    return files


@pytest.fixture
def retention(tmp_path: Path) -> Callable[[str], Retention]:
    pattern = FilePattern(str(tmp_path / "rec-%Y%m%d.mcap"))
    return lambda text: Retention(pattern, Keep.parse(text), is_split=True)


def test_files_older_than_the_age_are_deleted(week: list[Path], retention: Callable[[str], Retention]):
    kept = retention("84h")  # three and a half days
    deleted = list(kept.delete_excess({week[-1]}))
    assert [file.path for file in deleted] == week[:4]
    assert [path for path in week if path.exists()] == week[4:]
    assert (kept.deleted_files, kept.deleted_bytes) == (4, sum(file.size for file in deleted))


def test_oldest_files_are_deleted_until_the_rest_is_within_the_size(
    week: list[Path], retention: Callable[[str], Retention]
):
    sizes = [path.stat().st_size for path in week]
    kept = retention(f"{sum(sizes[3:]) / 1000.0:.3f}kB")
    assert [file.path for file in kept.delete_excess({week[-1]})] == week[:3]
    assert kept.kept_bytes == sum(sizes[3:])
    assert not list(kept.delete_excess({week[-1]}))


def test_files_being_written_stay(week: list[Path], retention: Callable[[str], Retention], tmp_path: Path):
    other = tmp_path / "rec-20250101.mcap"
    with RecordingWriter(other):
        os.utime(other, (0, 0))
        remaining = {week[0], other}
        deleted = [file.path for file in retention("1s").delete_excess({week[0]})]
        assert deleted == week[1:]
        assert set(tmp_path.iterdir()) == remaining
    os.utime(other, (0, 0))
    assert [file.path for file in retention("1s").delete_excess({week[0]})] == [other]


def test_growth_ends_at_the_bound(week: list[Path], retention: Callable[[str], Retention]):
    total = sum(path.stat().st_size for path in week)
    kept = retention("1MB")
    list(kept.delete_excess({week[-1]}))
    assert kept.kept_bytes == total
    assert kept.growth(1.0, 100.0) == 100.0
    assert kept.growth(1e3, DAY_S) == 1e6 - total
    by_age = retention("30d")
    list(by_age.delete_excess({week[-1]}))
    assert by_age.growth(1.0, DAY_S) == DAY_S
    # Old recordings are deleted as fast as new ones come.
    assert by_age.growth(total / (30 * DAY_S), DAY_S) == pytest.approx(0.0, abs=1e-6)


def test_growth_of_a_recording_that_does_not_split_has_no_bound(tmp_path: Path):
    kept = Retention(FilePattern(str(tmp_path / "%Y.mcap")), Keep.parse("1MB"), is_split=False)
    assert kept.growth(1e3, DAY_S) == 1e3 * DAY_S


def test_missing_folder_is_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    pattern = FilePattern(str(tmp_path / "gone" / "%Y.mcap"))
    assert not list(Retention(pattern, Keep.parse("1d"), is_split=True).delete_excess({tmp_path / "a"}))
    assert "cannot be listed" in caplog.text
