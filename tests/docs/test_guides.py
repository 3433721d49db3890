"""The guides of the documentation: each block of code is a program that runs here, or has a reason not to."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.pages import languages

ROOT = Path(__file__).parents[2]
GUIDES = sorted((ROOT / "docs" / "guides").glob("*.md"))

# Those of python, toml and console run. A block of text shows a format, or what needs hardware or root.
LANGUAGES = {"python", "toml", "console", "text"}


@pytest.mark.parametrize("guide", GUIDES, ids=lambda guide: guide.stem)
def test_no_block_is_in_a_language_that_does_not_run(guide: Path) -> None:
    assert languages(guide.read_text()) <= LANGUAGES
