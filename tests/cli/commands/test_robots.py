from __future__ import annotations

import json

from helpers.cli_runner import failure, run_cli

from zstate.model.catalog import catalog


def test_every_robot_of_the_catalog_is_listed_with_its_collection():
    lines = run_cli("robots").stdout.splitlines()
    assert [line.split()[0] for line in lines] == [entry.name for entry in catalog()]
    assert ["rrbot", "zstate"] in [line.split() for line in lines]


def test_a_text_narrows_the_list_and_an_unknown_one_fails():
    assert all("arm" in line for line in run_cli("robots", "ARM").stdout.splitlines())
    assert "no name of a robot model contains 'nosuch'" in failure("robots", "nosuch")


def test_json_has_the_paths():
    (entry,) = [one for one in json.loads(run_cli("robots", "--json").stdout) if one["name"] == "rrbot"]
    assert entry["path"].endswith("rrbot.urdf")
    assert entry["origin"] == "zstate"
