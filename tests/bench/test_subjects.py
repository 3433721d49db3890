"""The subjects, as imported by the runner and by foreign interpreters."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from bench.subjects import NAMES, subject_named

ROOT = Path(__file__).parents[2]

CODE = """
from bench.subjects import NAMES, subject_named
import bench.worker
print(*[subject_named(name).name for name in NAMES])
"""


@pytest.mark.processes
def test_all_subjects_and_the_worker_import_only_the_standard_library() -> None:
    # -S: no site-packages. A worker runs in the interpreter of its system, which may lack numpy.
    command = [sys.executable, "-S", "-c", CODE]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=30)
    assert result.stdout.split() == list(NAMES), result.stderr


@pytest.mark.parametrize("name", NAMES)
def test_every_subject_has_title_settings_and_install_commands(name: str) -> None:
    subject = subject_named(name)
    assert subject.name == name
    assert subject.title
    assert subject.settings
    assert subject.install


@pytest.mark.parametrize("name", NAMES)
def test_titles_and_settings_fit_a_markdown_cell(name: str) -> None:
    subject = subject_named(name)
    assert not any("|" in text or "\n" in text for text in (subject.title, *subject.settings))
