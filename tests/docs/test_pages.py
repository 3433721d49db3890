"""The pages of docs/ that are no guides: their programs and terminals run; files that they name exist."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import pytest
from helpers.pages import programs
from helpers.tutorial_terminal import TutorialPage, check_page

ROOT = Path(__file__).parents[2]
PAGES = ("concepts", "ros2")
"""With programs. The tutorial, which the second one includes, is in tests/cli/test_tutorial.py."""


@pytest.mark.processes
@pytest.mark.parametrize("page", PAGES)
def test_terminals_of_a_page_print_what_it_shows(page: str, tmp_path: Path) -> None:
    text = (ROOT / "docs" / f"{page}.md").read_text()
    for name, program in programs(text).items():
        (tmp_path / name).write_text(program)
    check_page(TutorialPage(text), tmp_path)


def test_generated_pages_are_those_of_the_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    for page, text in import_module("generate").PAGES.items():
        stored = (ROOT / "docs" / page).read_text()
        assert stored == text() + "\n", f"docs/{page} is not current: run `python docs/generate.py`"


def test_files_named_in_the_architecture_exist() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text()
    named = set(re.findall(r"`((?:\w+/)*\w+\.(?:py|c)|(?:\w+/)+)`", text))
    assert named
    tops = (ROOT / "zstate", ROOT)
    assert [name for name in named if not any((top / name).exists() for top in tops)] == []
