from __future__ import annotations

import pytest

from zstate.driving.cli.keyboard import FIRST_HOLD_S, HOLD_S, HeldKey, keys_in


def test_arrow_keys_of_both_modes_of_a_terminal_are_keys_as_letters_are():
    assert keys_in(b"wA \x1b[A\x1bOB\x1b[C\x1b[Dq") == ["w", "a", " ", "up", "down", "right", "left", "q"]


def test_other_sequences_and_characters_are_left_out():
    assert keys_in(b"\x1b[H\xc3\xa4d\x1b[") == ["d"]


@pytest.mark.parametrize(
    ("key", "rates"),
    [("w", (4.0, 4.0)), ("down", (-4.0, -4.0)), ("a", (-2.0, 2.0)), ("right", (2.0, -2.0))],
)
def test_wheels_turn_forward_back_or_against_each_other(key: str, rates: tuple[float, float]):
    held = HeldKey()
    held.press(key, 10.0)
    assert held.wheel_rates(10.0, 4.0) == rates


def test_a_key_is_held_until_the_terminal_would_have_repeated_it():
    held = HeldKey()
    held.press("w", 10.0)
    assert held.wheel_rates(10.0 + 0.9 * FIRST_HOLD_S, 1.0)
    assert held.wheel_rates(10.0 + FIRST_HOLD_S, 1.0) is None
    held.press("w", 11.0)
    held.press("w", 11.5)  # the first repetition
    assert held.wheel_rates(11.5 + 0.9 * HOLD_S, 1.0)
    assert held.wheel_rates(11.5 + HOLD_S, 1.0) is None


def test_another_key_ends_the_motion():
    held = HeldKey()
    held.press("w", 10.0)
    held.press(" ", 10.1)
    assert held.wheel_rates(10.1, 1.0) is None
