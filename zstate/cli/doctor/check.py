"""Result of one check of `zstate doctor`, and its text and JSON."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from zstate.cli.output.console import colored, count_text, output_width
from zstate.errors import printable
from zstate.stream_registry import edge_streams
from zstate.streams import JOINT_STREAMS

State = Literal["ok", "warning", "broken", "skipped"]

_COLORS = {"ok": "green", "warning": "yellow", "broken": "red", "skipped": None}
_STATE, _NAME, _MIN_TEXT = 7, 12, 20  # widths


@dataclass(frozen=True, slots=True)
class Check:
    """One link of the chain: its ``name``, its state, and the evidence in ``text``.

    ``next`` is the command to continue with. ``robot`` is None for links that all robots share. A link is
    skipped if the links before it leave nothing to check.
    """

    name: str
    state: State
    text: str
    next: str = ""
    robot: str | None = None


def ok(name: str, text: str) -> Check:
    """A link that works."""
    return Check(name, "ok", text)


def warning(name: str, text: str, then: str) -> Check:
    """A link that works, but may fail later or for other readers."""
    return Check(name, "warning", text, then)


def broken(name: str, text: str, then: str) -> Check:
    """A link that does not work."""
    return Check(name, "broken", text, then)


def skipped(name: str, text: str) -> Check:
    """A link that cannot be checked."""
    return Check(name, "skipped", text)


def first_broken(checks: Sequence[Check]) -> Check | None:
    """The link to repair first: failures of later links may follow from it."""
    return next((check for check in checks if check.state == "broken"), None)


def check_text(check: Check) -> str:
    """One check, wrapped at the width of the terminal; on one line if there is no terminal."""
    indent, state, name = "  " * bool(check.robot), f"{check.state:<{_STATE}}", f"{check.name:<{_NAME}}"
    head = f"{indent}{colored(state, _COLORS[check.state])}  {name}  "
    text, width = " ".join(check.text.split()), output_width()
    if width is None:
        return head + text
    column = len(f"{indent}{state}  {name}  ")
    lines = textwrap.wrap(text, max(width - column, _MIN_TEXT), break_on_hyphens=False)
    return head + f"\n{' ' * column}".join(lines)


def robot_lines(robot: str, checks: Sequence[Check], *, in_full: bool) -> Iterator[str]:
    """The checks of ``robot``; unless ``in_full`` only those that fail, or one line if all are ok."""
    shown = [check for check in checks if in_full or check.state in ("warning", "broken")]
    if shown:
        yield robot
        yield from map(check_text, shown)
    else:
        moves = [check.text for check in checks if check.name in (*JOINT_STREAMS, *edge_streams(), "tf")]
        yield check_text(Check(robot, "ok", "; ".join(moves) or "sound"))


def conclusion_text(checks: Sequence[Check]) -> str:
    """The first broken check, or the first warning, and the next command."""
    check, text = first_broken(checks), "all is sound"
    if check is not None:
        text = f"first broken link: {check.name}{f' of {check.robot!r}' if check.robot else ''}"
    elif warnings := [one for one in checks if one.state == "warning"]:
        check, text = warnings[0], f"sound, with {count_text(len(warnings), 'warning')}"
    return text + (f"\nnext: {printable(check.next)}" if check is not None and check.next else "")


def diagnosis_json(checks: Sequence[Check]) -> dict[str, Any]:
    """All checks as one JSON object."""
    first = first_broken(checks)
    return {
        "sound": first is None,
        "first_broken": None if first is None else asdict(first),
        "checks": [asdict(check) for check in checks],
    }
