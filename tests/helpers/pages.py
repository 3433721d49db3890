"""Pages of Markdown: their blocks, programs and commands.

A command of a page starts as a process with ``started(spawn, *command[1:])`` (helpers/cli_runner.py).
"""

from __future__ import annotations

import re
import shlex


def blocks(language: str, text: str) -> list[str]:
    """The contents of all blocks in ``language``."""
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def terminals(text: str) -> list[tuple[tuple[str, ...], str]]:
    """The blocks of terminals, each after what a comment before it names, ``<!-- varies: one; two -->``."""
    found = re.findall(
        r"^(?:<!-- varies: ([^\n]*) -->\n)?```console\n(.*?)^```$", text, re.MULTILINE | re.DOTALL
    )
    return [(tuple(varies.split("; ")) if varies else (), block) for varies, block in found]


def languages(text: str) -> set[str]:
    """The languages of all blocks; that of a block without one is empty."""
    return set(re.findall(r"^ *```([^\n`]*)\n.*?^ *```$", text, re.MULTILINE | re.DOTALL))


def programs(text: str, language: str = "python") -> dict[str, str]:
    """The blocks in ``language`` by their file names, each of which is the first line, a comment."""
    return {block.split("\n", 1)[0].removeprefix("# "): block for block in blocks(language, text)}


def section(text: str, heading: str) -> str:
    """The text between a heading, such as ``## Start``, and the next one of its level or above."""
    level = len(heading) - len(heading.lstrip("#"))
    _, found, rest = f"\n{text}".partition(f"\n{heading}\n")
    assert found, f"no heading {heading!r}"
    return re.split(rf"^#{{1,{level}}} ", rest, maxsplit=1, flags=re.MULTILINE)[0]


def commands(text: str) -> list[list[str]]:
    """The words of every ``$ zstate ...`` line of the console blocks, without comments."""
    lines = "".join(blocks("console", text)).splitlines()
    return [shlex.split(line, comments=True)[1:] for line in lines if re.match(r"\d?\$ zstate ", line)]
