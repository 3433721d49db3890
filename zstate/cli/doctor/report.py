"""What was found, for a person and for a program."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

from zstate.cli.doctor.check import Check, first_broken
from zstate.cli.output.console import colored, count_text, is_terminal

_COLORS = {"ok": "green", "warning": "yellow", "broken": "red", "skipped": None}
_STATE, _NAME = 7, 12
_NARROWEST = 20


def check_text(check: Check) -> str:
    """One link, as wide as the terminal; on one line where nobody sees it."""
    indent = "  " if check.robot else ""
    state, name = f"{check.state:<{_STATE}}", f"{check.name:<{_NAME}}"
    head = f"{indent}{colored(state, _COLORS[check.state])}  {name}  "
    text = " ".join(check.text.split())
    if not is_terminal():
        return head + text
    column = len(f"{indent}{state}  {name}  ")
    width = max(shutil.get_terminal_size().columns - column, _NARROWEST)
    return head + f"\n{' ' * column}".join(textwrap.wrap(text, width, break_on_hyphens=False))


def robot_lines(robot: str, checks: Sequence[Check], *, in_full: bool) -> Iterator[str]:
    """The links of ``robot``; unless ``in_full`` those alone that do not hold, and one line where all do."""
    telling = [check for check in checks if in_full or check.state in ("warning", "broken")]
    if telling:
        yield robot
        yield from map(check_text, telling)
    else:
        moves = [check.text for check in checks if check.name in ("joint_states", "tf")]
        yield check_text(Check(robot, "ok", moves[0] if moves else "sound"))


def verdict_text(checks: Sequence[Check]) -> str:
    """What to do next."""
    check = first_broken(checks)
    if check is None:
        worrying = [check for check in checks if check.state == "warning"]
        if not worrying:
            return "all is sound"
        return f"sound, with {count_text(len(worrying), 'warning')}{_next_text(worrying[0])}"
    return (
        f"first broken link: {check.name}{f' of {check.robot!r}' if check.robot else ''}{_next_text(check)}"
    )


def _next_text(check: Check) -> str:
    return f"\nnext: {check.next}" if check.next else ""


def facts(checks: Sequence[Check]) -> dict[str, Any]:
    """All of it as one JSON object."""
    first = first_broken(checks)
    return {
        "sound": first is None,
        "first_broken": None if first is None else asdict(first),
        "checks": [asdict(check) for check in checks],
    }
