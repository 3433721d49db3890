from __future__ import annotations

from zstate.cli.output.text_layout import short_labels, wrap


def test_what_fits_stays_as_it_is():
    assert wrap("a line\n  and  another", 14) == "a line\n  and  another"


def test_a_long_cell_goes_on_below_itself():
    line = "mode  client  option --connect, which alone means a router"
    assert wrap(line, 44).splitlines() == [
        "mode  client  option --connect, which alone",
        "              means a router",
    ]


def test_where_the_last_column_is_too_narrow_a_line_goes_on_with_an_indent():
    line = "  frame  " + "x" * 30 + "  and what is to be said of it"
    assert wrap(line, 45).splitlines() == [f"  frame  {'x' * 30}  and", "    what is to be said of it"]


def test_prose_is_folded_between_words_which_stay_whole():
    said = wrap("zstate: nothing answers at 'tcp/a-host-with-a-long-name:7447' (refused)", 30)
    assert said.splitlines() == [
        "zstate: nothing answers at",
        "  'tcp/a-host-with-a-long-name:7447'",
        "  (refused)",
    ]


def test_letters_stand_for_names_in_their_order():
    assert short_labels(["left", "right", "left"]) == {"left": "a", "right": "b"}
    assert list(short_labels(map(str, range(28))).values())[25:] == ["z", "27", "28"]
