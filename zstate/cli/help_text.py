"""HelpText: the help of a command, whose examples fit narrow terminals, too."""

from __future__ import annotations

import re

import click

# Which click leaves free.
_MARGIN = 2
# An example and what it is for, in columns.
_EXAMPLE = re.compile(r"( *)(\S.*?) {2,}(# .*)")


class HelpText(click.HelpFormatter):
    """As click writes it. Examples stay on one line, so the comment of one that is too long goes above it."""

    def getvalue(self) -> str:
        return "\n".join(part for line in super().getvalue().split("\n") for part in self._fitted(line))

    def _fitted(self, line: str) -> list[str]:
        example = _EXAMPLE.fullmatch(line)
        if example is None or len(line) <= self.width + _MARGIN:
            return [line]
        indent, command, comment = example.groups()
        return [indent + comment, indent + command]


class HelpContext(click.Context):
    """What commands are called in, with help of this kind."""

    formatter_class = HelpText
