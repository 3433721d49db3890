from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.cli_runner import RRBOT, failure, run_cli

from zstate import load_model

LINKS = '<robot name="arm">\n<link name="base"/>\n<link name="hand"/>\n'
SOUND = LINKS + '<joint name="wrist" type="fixed"><parent link="base"/><child link="hand"/></joint>\n</robot>'
WITHOUT_LIMIT = SOUND.replace('type="fixed"', 'type="revolute"')
HEAVY = SOUND.replace(
    '<link name="hand"/>', '<link name="hand"><inertial><mass value="-1"/></inertial></link>'
)


def deep(count: int) -> str:
    links = "".join(f'<link name="l{n}"/>' for n in range(count + 1))
    joints = "".join(
        f'<joint name="j{n}" type="fixed"><parent link="l{n}"/><child link="l{n + 1}"/></joint>'
        for n in range(count)
    )
    return f'<robot name="chain">{links}{joints}</robot>'


def test_a_sound_model_is_drawn_as_a_tree():
    ended = run_cli("check", RRBOT)
    headline, *lines = ended.stdout.splitlines()
    assert ended.code == 0
    assert "robot 'rrbot', 7 links, 6 joints (2 driven)" in headline
    assert lines[0] == "world"
    assert lines[2].split() == ["└──", "upper", "shoulder", "continuous"]
    assert len(lines) == 7


def test_a_missing_mesh_is_a_warning_with_its_line_and_where_it_was_searched(tmp_path: Path):
    mesh = '<visual><geometry><mesh filename="{}"/></geometry></visual>'
    visuals = "".join(mesh.format(uri) for uri in ("there.stl", "hand.stl", "package://nowhere/base.stl"))
    file = tmp_path / "arm.urdf"
    file.write_text(SOUND.replace('<link name="hand"/>', f'<link name="hand">\n{visuals}</link>'))
    (tmp_path / "there.stl").touch()
    ended = run_cli("check", str(file), "--json")
    assert ended.code == 0
    first, second = json.loads(ended.stdout)["findings"]
    assert (first["line"], first["severity"]) == (4, "warning")
    assert first["message"].startswith("the mesh 'hand.stl' is missing, so it is not drawn: ")
    assert str(tmp_path) in first["message"]
    assert "there is no package 'nowhere'" in second["message"]


def test_each_error_has_its_line():
    ended = run_cli("check", "-", stdin=WITHOUT_LIMIT.encode())
    headline, finding = ended.stdout.splitlines()
    assert ended.code == 1
    assert headline == "standard input cannot be used (1 error)"
    assert finding.split()[:3] == ["line", "4", "error"]
    assert "'wrist'" in finding


def test_fix_hints_print_a_correction_below_each_finding(tmp_path: Path):
    file = tmp_path / "my arm.urdf"
    file.write_text(WITHOUT_LIMIT)
    *_, advice = run_cli("check", str(file)).stdout.splitlines()
    assert advice == f"`zstate check '{file}' --fix-hints` prints corrections"
    _, _, fix = run_cli("check", str(file), "--fix-hints").stdout.splitlines()
    assert fix.strip().startswith('fix: <limit lower="-3.14" upper="3.14"')
    broken = run_cli("check", "-", "--json", stdin=WITHOUT_LIMIT.encode())
    assert json.loads(broken.stdout)["findings"][0]["fix"] in fix


def test_the_joints_are_a_table_in_the_order_of_their_positions():
    _, headings, *rows = run_cli("check", RRBOT, "--joints").stdout.splitlines()
    assert headings.split()[:5] == ["joint", "type", "parent", "child", "position"]
    moving = [row.split() for row in rows if " - " not in row[:60]]
    assert [(row[0], row[4]) for row in moving] == [("shoulder", "0"), ("elbow", "1")]


def test_warning_is_printed_and_exit_code_is_0():
    ended = run_cli("check", "-", stdin=HEAVY.encode())
    assert ended.code == 0
    assert ended.stdout.splitlines()[1].split()[:3] == ["line", "3", "warning"]


def test_a_name_of_the_catalog_is_checked_too():
    assert run_cli("check", "rrbot").stdout.startswith("rrbot: robot 'rrbot'")


def test_unknown_name_is_reported_with_near_misses():
    assert "rrbot" in failure("check", "rrbt")


def test_json_has_all_facts():
    facts = json.loads(run_cli("check", RRBOT, "--json").stdout)
    assert facts["usable"] is True
    assert facts["digest"] == load_model(RRBOT).digest
    assert [joint["name"] for joint in facts["joints"]][1] == "shoulder"
    assert facts["joints"][1]["lower"] is None  # continuous: JSON has no infinity
    broken = run_cli("check", "-", "--json", stdin=WITHOUT_LIMIT.encode())
    assert broken.code == 1
    assert json.loads(broken.stdout)["findings"][0]["line"] == 4


@pytest.mark.parametrize(
    "garbage",
    [b"", b"\x00\x01\x02\xff", b"<robot", "<robot name='é'/>".encode("latin-1"), b"just words"],
    ids=["empty", "binary", "truncated", "latin-1", "text"],
)
def test_garbage_fails_without_a_traceback(garbage: bytes):
    ended = run_cli("check", "-", stdin=garbage)
    assert ended.code == 1
    assert "Traceback" not in ended.stderr


def test_missing_file_is_named(tmp_path: Path):
    missing = str(tmp_path / "arm.urdf")
    ended = run_cli("check", missing)
    assert ended.code == 1
    assert "no such file" in ended.stdout


def test_the_deepest_allowed_chain_is_drawn():
    ended = run_cli("check", "-", stdin=deep(500).encode())
    assert ended.code == 0
    assert len(ended.stdout.splitlines()) == 502
