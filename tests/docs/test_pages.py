"""The pages of docs/ that are no guides: their programs and terminals run; files that they name exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from helpers.pages import languages, programs
from helpers.tutorial_terminal import TutorialPage, check_page

ROOT = Path(__file__).parents[2]
CONCEPTS = (ROOT / "docs" / "concepts.md").read_text()


@pytest.mark.processes
def test_terminals_of_the_concepts_print_what_the_page_shows(tmp_path: Path) -> None:
    for name, program in programs(CONCEPTS).items():
        (tmp_path / name).write_text(program)
    check_page(TutorialPage(CONCEPTS), tmp_path)


@pytest.mark.parametrize("name", ["architecture", "benchmarks", "ros2", "scale", "start", "view"])
def test_other_pages_have_no_blocks_that_run(name: str) -> None:
    """Blocks of the files that a page includes are tested with those files."""
    found = languages((ROOT / "docs" / f"{name}.md").read_text())
    assert {language for language in found if not language.startswith("{include}")} <= {"", "sh"}


def test_files_named_in_the_architecture_exist() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text()
    named = set(re.findall(r"`((?:\w+/)*\w+\.(?:py|c)|(?:\w+/)+)`", text))
    assert len(named) > 50
    tops = (ROOT / "zstate", ROOT)
    assert [name for name in named if not any((top / name).exists() for top in tops)] == []
