"""The notebooks run, and their stored outputs are those of a run.

`python tests/docs/test_notebooks.py` runs them and stores their outputs.
"""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from nbformat import NotebookNode

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"
DEADLINE_S = 60
VARIES = "varies"
"""The tag of cells that show stamps, or what was received in a time."""


def run(path: Path, folder: str | Path) -> NotebookNode:
    """The notebook with the outputs of a run in ``folder``. Raises CellExecutionError."""
    book = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(folder)}}
    NotebookClient(book, timeout=DEADLINE_S, record_timing=False, resources=resources).execute()
    book.metadata["language_info"] = {"name": "python"}  # without the version
    return book


def code_cells(book: NotebookNode) -> list[NotebookNode]:
    return [cell for cell in book.cells if cell.cell_type == "code"]


def texts(book: NotebookNode) -> list[list[str]]:
    """The text of each output of the cells that give the same in each run."""
    return [
        [output.get("text") or output.data["text/plain"] for output in cell.outputs]
        for cell in code_cells(book)
        if VARIES not in cell.metadata.get("tags", ())
    ]


@pytest.mark.processes
@pytest.mark.parametrize("name", ["live_lookups", pytest.param("training_set", marks=pytest.mark.robots)])
@pytest.mark.long
def test_a_notebook_runs_and_gives_the_outputs_that_it_has(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    path = FOLDER / f"{name}.ipynb"
    assert texts(run(path, tmp_path)) == texts(nbformat.read(path, as_version=4))


def test_stored_outputs_are_complete_and_small_and_name_no_machine() -> None:
    paths = sorted(FOLDER.glob("*.ipynb"))
    assert [path.stem for path in paths] == ["live_lookups", "training_set"]
    for path in paths:
        cells = code_cells(nbformat.read(path, as_version=4))
        assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
        assert path.stat().st_size < 100_000
        assert not re.search(r"/(home|root|tmp|usr)/|\bpid \d|Traceback|Warning", path.read_text())


if __name__ == "__main__":
    for notebook in FOLDER.glob("*.ipynb"):
        with tempfile.TemporaryDirectory() as scratch:
            nbformat.write(run(notebook, scratch), notebook)
