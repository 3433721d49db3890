"""The subjects, as imported by the runner and by foreign interpreters."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from bench.subjects import all_subjects

ROOT = Path(__file__).parents[2]
SUBJECTS = all_subjects()

CODE = """
from bench.subjects import all_subjects
import bench.worker
print(*all_subjects())
"""


@pytest.mark.processes
def test_all_subjects_and_the_worker_import_only_the_standard_library() -> None:
    # -S: no site-packages. A worker runs in the interpreter of its system, which may lack numpy.
    command = [sys.executable, "-S", "-c", CODE]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=30)
    assert result.stdout.split() == list(SUBJECTS), result.stderr


@pytest.mark.parametrize("name", SUBJECTS)
def test_every_subject_has_title_settings_and_install_commands_that_fit_a_markdown_cell(name: str) -> None:
    subject = SUBJECTS[name]
    assert subject.install
    texts = (subject.title, *subject.settings)
    assert all(text and "|" not in text and "\n" not in text for text in texts)
