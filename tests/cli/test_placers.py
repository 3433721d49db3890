"""Which robots may place the root of another one, in the commands that look up poses."""

from __future__ import annotations

import pytest
from helpers.cli_runner import failure, published_robot, run_until

from zstate import StaticPublisher, Transform, connect


@pytest.mark.parametrize(
    "command",
    [
        "tf thief/x rrbot/world",
        "monitor",
        "view --port 0",
        "plot --path rrbot/base rrbot/tool --seconds 60",
    ],
)
def test_a_robot_that_is_not_among_the_placers_is_refused(command: str):
    if command.startswith("plot"):
        pytest.importorskip("matplotlib", reason="pip install 'zstate[plot]'")
    with published_robot(), connect() as session, StaticPublisher(session, "thief", "edges") as statics:
        statics.set(Transform("thief/x", "rrbot/world", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
        run_until(
            lambda: True,
            *(*command.split(), "--placer", "site", "--placer", "fleet"),
            after="which is not among the placers ('fleet', 'site')",
        )


@pytest.mark.parametrize(
    ("command", "text"),
    [
        ("view run.mcap", "--placer are for live robots, not those of a recording"),
        ("plot --file run.mcap --path base tool", "--placer is for --path A B of live robots"),
        ("plot panda", "--placer is for --path A B of live robots"),
        ("monitor --robots", "--placer is for edges"),
    ],
)
def test_placers_are_refused_where_no_edge_is_placed(command: str, text: str):
    if command.startswith("plot"):
        pytest.importorskip("matplotlib", reason="pip install 'zstate[plot]'")
    assert text in failure(*command.split(), "--placer", "site", code=2)
