"""The tree as text, where the terminal is wide and where it is narrow."""

from __future__ import annotations

from zstate.buffer.frame_tree import FrameInfo
from zstate.cli.commands.tree import tree_text

NOW = 5_000_000_000
WRITER = "driver@jetson pid 412"


def joint(name: str, parent: str) -> FrameInfo:
    return FrameInfo(name, parent, "joint", WRITER, 100.0, NOW - 1_000_000_000, NOW - 2_000_000, 101)


FRAMES = (
    FrameInfo("r1/base", None, "root", None, None, None, None, 0),
    joint("r1/upper", "r1/base"),
    joint("r1/lower", "r1/upper"),
    FrameInfo("r1/tool", "r1/lower", "static", WRITER, None, None, None, 0),
    FrameInfo("r1/camera", "r1/lower", "static", "mount", None, None, None, 0),
)


def lines(width: int | None) -> list[str]:
    return tree_text(FRAMES, NOW, in_full=False, width=width).splitlines()


def test_wide_layout_has_all_columns():
    assert (
        lines(None)
        == lines(120)
        == [
            "frame               edge    rate      age     writer",
            "r1/base             root",
            "└── upper           joint   100.0 Hz  2.0 ms  driver@jetson pid 412",
            "    └── lower       joint   100.0 Hz  2.0 ms  driver@jetson pid 412",
            "        ├── camera  static                    mount",
            "        └── tool    static                    driver@jetson pid 412",
        ]
    )


def test_siblings_are_sorted():
    assert tree_text(FRAMES[::-1], NOW, in_full=False) == tree_text(FRAMES, NOW, in_full=False)


def test_a_narrow_terminal_has_letters_for_the_writers():
    assert lines(55) == [
        "frame               edge    rate      age     writer",
        "r1/base             root",
        "└── upper           joint   100.0 Hz  2.0 ms  a",
        "    └── lower       joint   100.0 Hz  2.0 ms  a",
        "        ├── camera  static                    b",
        "        └── tool    static                    a",
        "a: driver@jetson pid 412",
        "b: mount",
    ]


def test_narrower_layout_indents_only_at_forks():
    assert lines(45)[1:6] == [
        "r1/base   root",
        "↓ upper   joint   100.0 Hz  2.0 ms  a",
        "↓ lower   joint   100.0 Hz  2.0 ms  a",
        "├ camera  static                    b",
        "└ tool    static                    a",
    ]


def test_narrowest_layout_omits_the_kind_of_moving_edges():
    assert lines(33)[1] == "↓ upper   100.0 Hz 2.0 ms  a"
