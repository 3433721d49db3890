"""The subjects, as the runner and foreign interpreters see them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from bench.subjects import NAMES, subject_named

ROOT = Path(__file__).parents[2]

LOOK = """
from bench.subjects import NAMES, subject_named
import bench.worker
print(*[subject_named(name).name for name in NAMES])
"""


@pytest.mark.processes
def test_all_of_them_are_read_without_anything_but_the_standard_library() -> None:
    # -S: no site-packages. A worker runs in the interpreter of its system, which has no numpy to spare.
    command = [sys.executable, "-S", "-c", LOOK]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=30)
    assert said.stdout.split() == list(NAMES), said.stderr


@pytest.mark.parametrize("name", NAMES)
def test_each_says_what_it_was_set_to_and_how_it_is_installed(name: str) -> None:
    subject = subject_named(name)
    assert subject.name == name
    assert subject.title
    assert subject.settings
    assert subject.install


@pytest.mark.parametrize("name", NAMES)
def test_titles_and_sentences_have_no_character_that_would_end_a_cell(name: str) -> None:
    subject = subject_named(name)
    assert not any("|" in text or "\n" in text for text in (subject.title, *subject.settings))
