from __future__ import annotations

import json
from xml.etree import ElementTree

import pytest
from helpers.cli_runner import failure, published_robot, run_cli

from zstate import StaticPublisher, Transform, connect


def drawn(*arguments: str) -> list[str]:
    ended = run_cli("tree", *arguments)
    assert ended.code == 0, ended.stderr
    return ended.stdout.splitlines()


def test_each_edge_has_its_kind_rate_age_and_writer():
    with published_robot():
        heading, root, *lines = drawn()
    assert heading.split() == ["frame", "edge", "rate", "age", "writer"]
    assert root.split() == ["rrbot/world", "root"]
    assert [line.lstrip(" │├└─").split()[0] for line in lines] == [
        "base",
        "upper",
        "lower",
        "camera_link",
        "laser_link",
        "tool",
    ]
    upper = lines[1].split()
    assert upper[1:3] == ["upper", "joint"]
    assert upper[4] == "Hz"
    assert "pid" in upper
    assert lines[0].split()[2] == "static"


def test_guides_show_parents_and_children():
    with published_robot():
        lines = drawn()
    assert lines[2].startswith("└── base ")
    assert lines[5].startswith("            ├── camera_link ")
    assert lines[7].startswith("            └── tool ")


@pytest.mark.parametrize(
    ("options", "parent"),
    [([], "thief/x"), (["--placer", "thief"], "thief/x"), (["--placer", "site", "--placer", "fleet"], None)],
)
def test_only_placers_place_the_root_of_another_robot(options: list[str], parent: str | None):
    with published_robot(), connect() as session, StaticPublisher(session, "thief", "edges") as statics:
        statics.set(Transform("thief/x", "rrbot/world", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
        frames = json.loads("\n".join(drawn("--json", *options)))
    assert {frame["name"]: frame["parent"] for frame in frames}["rrbot/world"] == parent


def test_static_edges_of_other_writers_are_in_the_tree():
    with published_robot(), connect() as session, StaticPublisher(session, "rrbot", "mount") as statics:
        statics.set(Transform("tool", "gauge", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0)))
        gauge = next(line for line in drawn() if "gauge" in line)
    assert gauge.split()[-2:] == ["static", "mount"]


def test_json_has_every_frame():
    with published_robot():
        frames = {frame["name"]: frame for frame in json.loads("\n".join(drawn("rrbot", "--json")))}
    assert frames["rrbot/lower"]["parent"] == "rrbot/upper"
    assert frames["rrbot/lower"]["kind"] == "joint"
    assert frames["rrbot/lower"]["count"] >= 2
    assert frames["rrbot/world"]["parent"] is None


def test_dot_and_mermaid_have_an_edge_for_each_frame_except_the_root():
    with published_robot():
        dot, mermaid = drawn("--dot"), drawn("--mermaid")
    assert dot[0] == "digraph frames {"
    assert '  "rrbot/world" -> "rrbot/base" [label="static"];' in dot
    assert sum("->" in line for line in dot) == 6
    assert mermaid[0] == "graph TD"
    assert '  n0["rrbot/world"]' in mermaid
    assert sum("-->" in line for line in mermaid) == 6


def test_the_picture_is_svg_with_every_frame_and_writer():
    with published_robot(), connect() as session, StaticPublisher(session, "rrbot", "<mount>") as statics:
        statics.set(Transform("tool", "gauge & dial", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0)))
        root = ElementTree.fromstring("\n".join(drawn("rrbot", "--svg")))
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    texts = [element.text or "" for element in root.iter("{http://www.w3.org/2000/svg}text")]
    assert {"rrbot/world", "base", "upper", "lower", "tool", "gauge & dial"} <= set(texts)
    assert "<mount>: 1 edge" in texts
    assert sum(text.startswith("joint · ") and "Hz" in text for text in texts) == 2


def test_missing_robot_error_lists_the_others():
    with published_robot():
        message = failure("tree", "rrbt")
    assert "did you mean 'rrbot'?" in message
    assert "announced: 'rrbot'" in message


def test_empty_network_is_no_error_and_prints_how_to_start():
    ended = run_cli("tree")
    assert (ended.code, ended.stdout) == (0, "")
    assert "zstate publish" in ended.stderr
    assert json.loads(run_cli("tree", "--json").stdout) == []
    assert "robot 'rrbot' is not announced" in failure("tree", "rrbot")


def test_joint_states_without_model_have_no_tree_and_print_how_to_publish_one():
    with published_robot(streams=("joint_states",)):
        ended = run_cli("tree")
    assert ended.code == 0
    assert ended.stdout == ""
    assert "zstate publish" in ended.stderr
