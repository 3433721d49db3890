"""HelpText: the help of a command, whose examples fit narrow terminals, and whose own options come first."""

from __future__ import annotations

import re
from collections.abc import Iterable

import click

# Which click leaves free.
_MARGIN = 2
# An example and what it is for, in columns.
_EXAMPLE = re.compile(r"( *)(\S.*?) {2,}(# .*)")


# What every command that joins the network has, by the same names.
_NETWORK = frozenset(
    ("--mode", "--connect", "--listen", "--config", "--certs", "--identity", "--user", "--password-file")
)


class HelpText(click.HelpFormatter):
    """As click writes it, but for two things.

    The options that every command has for the network are a section of their own, below its own options.
    Examples stay on one line, so the comment of one that is too long goes above it.
    """

    def write_dl(self, rows: Iterable[tuple[str, str]], col_max: int = 30, col_spacing: int = 2) -> None:
        rows = list(rows)
        network = [row for row in rows if row[0].split(" ")[0] in _NETWORK]
        if len(network) < len(_NETWORK):
            super().write_dl(rows, col_max, col_spacing)
            return
        super().write_dl([row for row in rows if row not in network], col_max, col_spacing)
        self.dedent()
        with self.section("Network, the same for every command"):
            super().write_dl(network, col_max, col_spacing)
        self.indent()

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
