"""Files and options with thousands of nested brackets, on which Python's readers end in RecursionError."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from zstate.cli.commands.transform import _parse_line
from zstate.cli.output.logs import text_in
from zstate.cli.up.static_edges import read_calibration
from zstate.cli.up.template import TomlFile, _parsed_like
from zstate.errors import ConfigError, InvalidInput
from zstate.odometry.cli.settings_file import read_settings
from zstate.recording.cli.snapshot_file import read_snapshot

NESTED = "[" * 50_000


@pytest.mark.parametrize(
    ("read", "name", "begin"),
    [
        (TomlFile, "cell.toml", "a = "),
        (TomlFile, "tables.toml", "a = " + "{a = " * 50_000),
        (read_settings, "odometry.toml", "imu = "),
        (read_snapshot, "snapshot.toml", "a = "),
        (read_snapshot, "snapshot.json", ""),
        (read_calibration, "calibration.json", ""),
        (read_calibration, "calibration.yaml", ""),
    ],
)
def test_a_deeply_nested_file_is_refused_by_its_name(
    read: Callable[[Path], object], name: str, begin: str, tmp_path: Path
):
    path = tmp_path / name
    path.write_text(begin + NESTED)
    with pytest.raises(ConfigError, match=rf"{name} cannot be read: it.* nested too deeply"):
        read(path)


def test_deeply_nested_options_and_lines_are_refused():
    with pytest.raises(InvalidInput, match="is not of that type"):
        _parsed_like(1, NESTED)
    with pytest.raises(InvalidInput, match="nested too deeply"):
        _parse_line(NESTED)
    assert text_in(NESTED) == NESTED
