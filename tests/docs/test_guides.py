"""The guides of the documentation: their programs and terminals run here, and print what the pages show."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
from helpers.husky_recording import write_husky
from helpers.pages import blocks, languages, programs, section
from helpers.processes import find_free_port
from helpers.tutorial_terminal import TutorialPage, check_page

from zstate import errors
from zstate.errors import (
    AmbiguousFrame,
    ClockMismatch,
    Disconnected,
    InFuture,
    InPast,
    LookupFailed,
    NoData,
    NotFinite,
    Stale,
    UnknownFrame,
)

ROOT = Path(__file__).parents[2]
RECORDINGS = {"husky.mcap": write_husky}
"""What writes the recordings of real robots that guides replay."""
GUIDES = {path.stem: path.read_text() for path in sorted((ROOT / "docs" / "guides").glob("*.md"))}

# Blocks of the first three run. A block of text says why it cannot, in the sentence before it.
LANGUAGES = {"python", "toml", "console", "text", "{warning}"}


def files(text: str) -> dict[str, str]:
    return programs(text) | programs(text, "toml")


def on_this_host(text: str) -> str:
    """The text with other hosts' addresses replaced by this one's, and each port by a free one."""
    for port in set(re.findall(r"(?<=:)74\d\d\b", text)):
        text = text.replace(f":{port}", f":{find_free_port()}")
    return re.sub(r"192\.168\.1\.\d+|0\.0\.0\.0", "127.0.0.1", text)


@pytest.mark.parametrize("guide", GUIDES)
def test_blocks_are_in_languages_that_run(guide: str) -> None:
    assert languages(GUIDES[guide]) <= LANGUAGES


@pytest.mark.parametrize("guide", GUIDES)
def test_every_file_of_a_guide_is_used_in_its_terminals(guide: str) -> None:
    used = [line for line in "".join(blocks("console", GUIDES[guide])).splitlines() if line.startswith("$ ")]
    assert [name for name in files(GUIDES[guide]) if name not in " ".join(used)] == []


@pytest.mark.processes
@pytest.mark.parametrize("guide", GUIDES)
@pytest.mark.long
def test_terminals_print_what_the_guide_shows(
    guide: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    folder = tmp_path / "guide"
    folder.mkdir()
    (folder / "models").symlink_to(ROOT / "models")
    text = on_this_host(GUIDES[guide])
    for name, content in files(text).items():
        (folder / name).write_text(content)
    for name, write in RECORDINGS.items():
        if name in text:
            write(folder / name)
    check_page(TutorialPage(text), folder)


def test_sentences_in_the_guides_of_odometry_are_those_of_the_code() -> None:
    """Numbers differ: the words between them are in a literal of the package."""
    written = [
        node.value
        for path in sorted((ROOT / "zstate" / "odometry").glob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]
    pages = "".join(text for name, text in GUIDES.items() if name.startswith("odometry"))
    tables = [text.partition("\n\n")[0] for text in pages.split("| sentence |")[1:]]
    rows = [row for table in tables for row in table.splitlines()[2:]]
    quoted = re.findall(r"`([^`]*)`", "".join(f"{row.split(' | ')[0]}\n" for row in rows))
    assert len(quoted) > 20
    for sentence in quoted:
        split = re.split(r"\d[\d.]*(?: s\b| readings?)?|'\w+'|\.\.\.|[,;:]", sentence)
        words = [part.strip(" .,:'") for part in split]
        assert [part for part in words if part and not any(part in text for text in written)] == [], sentence


def lookup_failures() -> list[LookupFailed]:
    """An error for each kind of message."""
    frames, edge, second = ("map", "tool"), ("map", "base"), 1_000_000_000
    samples = {"edge": edge, "oldest": 10 * second, "newest": 20 * second}
    one_sample = samples | {"newest": 10 * second}
    edges, robots = (edge, ("base", "tool")), ("r1", "r2")
    withdrawn = Disconnected(*frames, roots=frames, edge=edge)
    withdrawn.gone_s = 5.0
    recorded = InPast(*frames, **samples, requested=second)
    recorded.is_recorded = True
    return [
        UnknownFrame(*frames, name="tool"),
        UnknownFrame(*frames, name="tool", frame_count=3),
        UnknownFrame(*frames, name="tool", frame_count=3, near_misses=("tool0",)),
        AmbiguousFrame(*frames, name="tool", candidates=("r1/tool", "r2/tool")),
        withdrawn,
        NoData(*frames, edge=edge),
        NoData(*frames),
        InFuture(*frames, **samples, requested=30 * second),
        InFuture(*frames, **one_sample, requested=30 * second),
        InPast(*frames, **samples, requested=second),
        InPast(*frames, **one_sample, requested=second),
        recorded,
        Stale(*frames, **samples, age_s=2.0, max_age_s=0.1),
        Stale(*frames, **samples, age_s=20.0, other_newest=40 * second),
        Stale(*frames, **samples, age_s=2e9, other_newest=2 * 10**9 * second),
        ClockMismatch(*frames, edges=edges, robots=robots, domains=("system", "simulated")),
        ClockMismatch(*frames, edges=edges[:1], robots=robots[:1], domains=("system", "simulated")),
        NotFinite(*frames, edge=edge),
    ]


def test_messages_in_the_guide_of_lookups_lead_to_the_sections_of_their_errors() -> None:
    text = section(GUIDES["lookup"], "## When a lookup fails")
    rows = re.findall(r"^\| ([^|]+) \| \[(\w+)\]\(#(\w+)\) \|$", text, re.MULTILINE)
    failures = lookup_failures()
    for message, name, anchor in rows:
        assert anchor == name.lower()
        assert any(message in str(one) for one in failures if type(one).__name__ == name), message
    unlisted = [one for one in failures if not any(message in str(one) for message, _, _ in rows)]
    assert unlisted == []
    sections = set(re.findall(r"^### (\w+)$", text, re.MULTILINE))
    assert sections == {name for _, name, _ in rows}
    classes = [
        one for one in vars(errors).values() if isinstance(one, type) and issubclass(one, LookupFailed)
    ]
    public = {one.__name__ for one in classes if not one.__name__.startswith("_")}
    assert sections == public - {"LookupFailed", "WaitTimeout"}  # the base, and what a wait adds to a class
