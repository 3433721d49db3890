from __future__ import annotations

from zstate.cli.layout import fitted, letters_for


def test_what_fits_stays_as_it_is():
    assert fitted("a line\n  and  another", 14) == "a line\n  and  another"


def test_a_long_cell_goes_on_below_itself():
    line = "mode  client  option --connect, which alone means a router"
    assert fitted(line, 44).splitlines() == [
        "mode  client  option --connect, which alone",
        "              means a router",
    ]


def test_where_the_last_column_is_too_narrow_a_line_goes_on_with_an_indent():
    line = "  frame  " + "x" * 30 + "  and what is to be said of it"
    assert fitted(line, 45).splitlines() == [f"  frame  {'x' * 30}  and", "    what is to be said of it"]


def test_prose_is_folded_between_words_which_stay_whole():
    said = fitted("zstate: nothing answers at 'tcp/a-host-with-a-long-name:7447' (refused)", 30)
    assert said.splitlines() == [
        "zstate: nothing answers at",
        "  'tcp/a-host-with-a-long-name:7447'",
        "  (refused)",
    ]


def test_letters_stand_for_names_in_their_order():
    assert letters_for(["left", "right", "left"]) == {"left": "a", "right": "b"}
    assert list(letters_for(map(str, range(28))).values())[25:] == ["z", "27", "28"]
