from __future__ import annotations

from looking import RRBOT

from zstate.cli.options import load_robot


def test_a_robot_of_the_catalog_is_called_as_it_was_asked_for():
    assert load_robot("RRbot", None)[1] == "rrbot"
    assert load_robot(RRBOT, None)[1] == load_robot(RRBOT, None)[0].name
    assert load_robot("rrbot", "left")[1] == "left"
