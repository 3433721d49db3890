"""The figures of the documents are those of the results that they name, and not too old."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from helpers.fake_results import write_results

from bench import page
from bench.page import COMMAND, END, MEASURED, ROOT, CannotKnow, better, documents, shown_folders, why_stale
from bench.results import Results

FACTORS = {"zstate_peer": 1.0, "ros1": 4.0, "raw_zenoh": 0.8}

PROGRAM = """
import sys
import zstate
zstate.StatePublisher, zstate.StaticPublisher, zstate.TransformListener, zstate.load_model, zstate.SineSource
print(*sorted(name for name in sys.modules if name.partition(".")[0] == "zstate"))
"""


def shown_results() -> Results:
    [folder] = shown_folders()
    return Results.read(folder)


def test_documents_show_the_figures_of_the_results_that_they_name() -> None:
    for path, text in documents(shown_results()).items():
        assert END in text
        assert path.read_text(encoding="utf-8") == text, f"`{COMMAND} FOLDER` writes it"


def test_figures_are_not_older_than_what_they_measure() -> None:
    """A checkout without history cannot know, and says so; the workflows fetch all of it."""
    try:
        reason = why_stale(shown_results())
    except CannotKnow as unknown:
        warnings.warn(f"the age of the figures cannot be known: {unknown}", stacklevel=1)
    else:
        assert reason is None, reason


def test_repository_has_the_results_of_the_shown_run_only() -> None:
    folders = {path for path in (ROOT / "bench" / "results").iterdir() if path.is_dir()}
    assert shown_folders() == folders


def test_measured_path_has_every_module_that_a_publisher_and_a_listener_load() -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=ROOT, capture_output=True, text=True, check=True, timeout=60
    )
    outside: list[str] = []
    for name in done.stdout.split():
        path = name.replace(".", "/")
        if not any(one in {path, f"{path}.py"} or path.startswith(f"{one}/") for one in MEASURED):
            outside.append(name)
    assert [name for name in outside if name not in ("zstate", "zstate._kernel")] == []
    assert [one for one in MEASURED if not (ROOT / one).exists()] == []


def fake_git(answers: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page, "git", lambda command, *_: answers[command])


@pytest.mark.parametrize(
    ("changed", "commits", "is_stale"),
    [
        ("2026-03-03 03:04:05 +0000", "300", False),
        ("2026-03-04 03:04:06 +0000", "0", True),
        ("2026-01-03 00:00:00 +0000", "301", True),
        ("2025-12-03 00:00:00 +0000", "0", False),
    ],
)
def test_figures_are_stale_after_60_days_or_300_commits(
    changed: str, commits: str, is_stale: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_git({"rev-parse": "false", "log": changed, "rev-list": commits}, monkeypatch)
    reason = why_stale(write_results(tmp_path, FACTORS))  # of 2026-01-02 03:04:05
    assert (reason is not None) == is_stale
    if reason is not None:
        assert f"`{COMMAND}` renews them" in reason


def test_age_is_unknown_in_a_shallow_clone_and_without_git(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = write_results(tmp_path, FACTORS)

    def unknown_commit(command: str, *arguments: str) -> str:
        if command == "rev-list":
            raise subprocess.CalledProcessError(128, command)
        return {"rev-parse": "false", "log": ""}[command]

    monkeypatch.setattr(page, "git", unknown_commit)
    with pytest.raises(CannotKnow, match="does not know the commit abc1234"):
        why_stale(results)
    fake_git({"rev-parse": "true"}, monkeypatch)
    with pytest.raises(CannotKnow, match="git fetch --unshallow"):
        why_stale(results)
    monkeypatch.undo()
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(CannotKnow, match="No such file or directory"):
        why_stale(results)


def test_comparison_names_each_figure_in_which_another_system_is_better(tmp_path: Path) -> None:
    results = write_results(tmp_path, FACTORS)
    text = "\n".join(better(results, results.scenario("talos", 1000.0)))
    # Memory falls with the factor: ROS 1 has a third process.
    assert text.count("\n- ") == 1
    assert "memory, all processes [MB], ROS 1: 35.8 [34.1 to 37.5] against 95.5 [90.9 to 100]" in text
    assert "spread" not in text
    assert "raw Zenoh" not in text


def test_comparison_marks_a_lead_within_the_spread_of_the_rounds(tmp_path: Path) -> None:
    results = write_results(tmp_path, {"zstate_peer": 1.0, "ros1": 0.98})
    lines = list(better(results, results.scenario("talos", 1000.0)))
    [line] = [one for one in lines if "latency p50" in one]
    assert line.endswith("(within the spread of the rounds)")


def test_comparison_without_a_better_system_says_so(tmp_path: Path) -> None:
    results = write_results(tmp_path, {"zstate_peer": 1.0, "raw_zenoh": 0.5})
    assert list(better(results, results.scenario("talos", 1000.0))) == [
        "talos at 1000 Hz: no other system is better than zstate in any of these figures."
    ]
