"""The guides of the documentation: their programs and terminals run here, and print what the pages show."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
from helpers.husky_recording import write_husky
from helpers.pages import blocks, languages, programs
from helpers.processes import find_free_port
from helpers.tutorial_terminal import TutorialPage, check_page

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
