from __future__ import annotations

from zstate.cli.output.text_layout import Table, first_fitting, short_labels, wrap


def test_fitting_text_is_unchanged():
    assert wrap("a line\n  and  another", 14) == "a line\n  and  another"


def test_a_long_cell_is_folded_below_itself():
    line = "mode  client  option --connect, which alone means a router"
    assert wrap(line, 44).splitlines() == [
        "mode  client  option --connect, which alone",
        "              means a router",
    ]


def test_line_with_a_too_narrow_last_column_is_folded_with_an_indent():
    line = "  frame  " + "x" * 30 + "  and a remark about this frame"
    assert wrap(line, 45).splitlines() == [f"  frame  {'x' * 30}  and", "    a remark about this frame"]


def test_prose_is_folded_between_words_which_stay_whole():
    wrapped = wrap("zstate: nothing answers at 'tcp/a-host-with-a-long-name:7447' (refused)", 30)
    assert wrapped.splitlines() == [
        "zstate: nothing answers at",
        "  'tcp/a-host-with-a-long-name:7447'",
        "  (refused)",
    ]


def test_short_labels_follow_the_order_of_names():
    assert short_labels(["left", "right", "left"]) == {"left": "a", "right": "b"}
    assert list(short_labels(map(str, range(28))).values())[25:] == ["z", "27", "28"]


ROWS = (
    ("base", "root", ""),
    ("arm", "joint", "driver@jetson pid 4"),
    ("hand", "joint", "driver@jetson pid 4"),
)
TABLE = Table(("frame", "kind", "writer"), ROWS, optional=("kind",), abbreviate="writer")


def test_a_table_with_enough_width_is_complete():
    assert (
        TABLE.lines(None)
        == TABLE.lines(33)
        == [
            "frame  kind   writer",
            "base   root",
            "arm    joint  driver@jetson pid 4",
            "hand   joint  driver@jetson pid 4",
        ]
    )


def test_a_narrow_table_first_abbreviates_names_then_omits_optional_columns():
    legend = "a: driver@jetson pid 4"
    assert TABLE.lines(32) == [
        "frame  kind   writer",
        "base   root",
        "arm    joint  a",
        "hand   joint  a",
        legend,
    ]
    narrowest = ["frame  writer", "base", "arm    a", "hand   a", legend]
    assert TABLE.lines(15) == TABLE.lines(1) == narrowest


def test_of_several_tables_the_first_that_fits_is_printed():
    other = Table(("frame", "kind"), [row[:2] for row in ROWS], headed=False)
    assert first_fitting((TABLE, other), 32)[0] == "frame  kind   writer"
    assert first_fitting((TABLE, other), 11) == ["base  root", "arm   joint", "hand  joint"]
