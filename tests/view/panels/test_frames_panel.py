"""Search: a part of a name finds the frame."""

from __future__ import annotations

from zstate.view.panels.frames_panel import search_frames

NAMES = (
    "panda/panda_link0",
    "panda/panda_hand_tcp",
    "panda/panda_hand",
    "talos/gripper_left_link",
    "talos/gripper_right_link",
    "talos/hand",
)


def test_nothing_asked_finds_everything_as_it_stands():
    assert search_frames(NAMES, "  ") == NAMES


def test_a_frame_that_is_called_so_comes_first_then_the_rest_in_their_order():
    assert search_frames(NAMES, "hand") == ("talos/hand", "panda/panda_hand_tcp", "panda/panda_hand")
    assert search_frames(NAMES, "panda_hand") == ("panda/panda_hand", "panda/panda_hand_tcp")


def test_a_frame_that_begins_so_comes_before_one_that_has_it_inside():
    assert search_frames(NAMES, "gripper")[0] == "talos/gripper_left_link"
    assert search_frames(("r/a_left", "r/left_arm"), "left") == ("r/left_arm", "r/a_left")


def test_all_words_have_to_occur_in_any_order_and_case():
    assert search_frames(NAMES, "LEFT talos") == ("talos/gripper_left_link",)
    assert search_frames(NAMES, "link/gripper_right") == ("talos/gripper_right_link",)


def test_what_is_misspelt_finds_what_is_spelt_nearly_so():
    assert search_frames(NAMES, "panda_hnad")[0] == "panda/panda_hand"
    assert search_frames(NAMES, "xyzzy") == ()
