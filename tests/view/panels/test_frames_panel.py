"""Search for frames by parts of their names."""

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


def test_empty_query_returns_all_frames_in_order():
    assert search_frames(NAMES, "  ") == NAMES


def test_exact_name_comes_first_then_the_others_in_order():
    assert search_frames(NAMES, "hand") == ("talos/hand", "panda/panda_hand_tcp", "panda/panda_hand")
    assert search_frames(NAMES, "panda_hand") == ("panda/panda_hand", "panda/panda_hand_tcp")


def test_prefix_matches_come_before_inner_matches():
    assert search_frames(NAMES, "gripper")[0] == "talos/gripper_left_link"
    assert search_frames(("r/a_left", "r/left_arm"), "left") == ("r/left_arm", "r/a_left")


def test_all_words_must_occur_in_any_order_and_case():
    assert search_frames(NAMES, "LEFT talos") == ("talos/gripper_left_link",)
    assert search_frames(NAMES, "link/gripper_right") == ("talos/gripper_right_link",)


def test_misspelt_query_returns_similar_names():
    assert search_frames(NAMES, "panda_hnad")[0] == "panda/panda_hand"
    assert search_frames(NAMES, "xyzzy") == ()
