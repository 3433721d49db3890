from __future__ import annotations

from zstate import load_model
from zstate.model.representative_links import representative_links


def test_representative_links_are_ends_of_branches_and_links_between():
    # Both wheels turn on the base; the camera and the laser are fixed on the lower link.
    assert representative_links(load_model("diffbot")) == ("left_wheel", "right_wheel")
    assert representative_links(load_model("rrbot")) == ("lower", "upper")


def test_a_robot_without_joints_has_no_representative_links():
    assert representative_links(load_model("<robot name='stone'><link name='stone'/></robot>")) == ()
