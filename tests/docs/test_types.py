"""Programs of the pages, notebooks and example drivers pass mypy --strict, and pyright in strict mode."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from helpers.pages import programs

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"

CLAIMS = '''"""What the types of the API say. A mistake is marked; a mark without a mistake is an error."""

from guides_driving_hardware import Arm

import zstate
from zstate.driving import Driver

arm: Driver = Arm(("shoulder", "elbow"))
buffer = zstate.TransformBuffer()
pose = buffer.lookup("map", "base")
next_stamp: int = pose.stamp + 1
stamps: list[int] = [buffer.twist("base", "map").stamp, buffer.plan("map", "base").at().stamp]
holds_at_any_time = pose.stamp is None
failure: type[zstate.errors.MessageError] = zstate.errors.MessageError

text: str = pose.stamp  # type: ignore[assignment]
zstate.Transfrom(pose)  # type: ignore[attr-defined]
zstate.driving.Commandr(pose)  # type: ignore[attr-defined]
buffer.lookup_transform("map", "base")  # type: ignore[attr-defined]
'''

UNTYPED = (
    "IPython.display",
    "dynamixel_sdk",
    "matplotlib.pyplot",
    "mujoco",
    "pandas",
    "pinocchio",
    "rtde_control",
    "rtde_receive",
    "scipy.spatial.transform",
)
"""Modules without types, of which checkers know nothing or guess: they are Any here, which a stub says."""


def write_programs(folder: Path) -> list[Path]:
    """The programs of all pages, and those that the tutorial names: ``guides_lookup_poses.py`` is one."""
    found = {f"tutorial_{path.name}": path.read_text() for path in (ROOT / "models/tutorial").glob("*.py")}
    for page in (ROOT / "README.md", *DOCS.rglob("*.md")):
        place = page.relative_to(DOCS if page.is_relative_to(DOCS) else ROOT).with_suffix("")
        prefix = "_".join(place.parts).lower()
        found |= {f"{prefix}_{name}": text for name, text in programs(page.read_text()).items()}
    for name, text in found.items():
        (folder / name).write_text(text)
    return [folder / name for name in sorted(found)]


def write_drivers(folder: Path) -> None:
    """The example drivers."""
    for path in (ROOT / "models/drivers").glob("*.py"):
        (folder / path.name).write_text(path.read_text())


def write_notebooks(folder: Path) -> None:
    """The code of each notebook as an async function, as cells may await."""
    for path in (DOCS / "notebooks").glob("*.ipynb"):
        cells = [one for one in json.loads(path.read_text())["cells"] if one["cell_type"] == "code"]
        code = "\n".join(displayed("".join(one["source"])) for one in cells)
        text = f"async def notebook() -> None:\n{textwrap.indent(code, '    ')}"
        (folder / f"notebook_{path.stem}.py").write_text(text)


def displayed(cell: str) -> str:
    """The cell with its value, that of a last expression, printed."""
    last = ast.parse(cell).body[-1]
    if not isinstance(last, ast.Expr):
        return cell
    lines = cell.splitlines()
    return "\n".join((*lines[: last.lineno - 1], f"print({ast.unparse(last)})"))


def write_stubs(folder: Path) -> None:
    for module in UNTYPED:
        *packages, _ = parts = module.split(".")
        stub = folder.joinpath(*parts, "__init__.pyi")
        stub.parent.mkdir(parents=True)
        for depth in range(1, len(packages) + 1):
            folder.joinpath(*parts[:depth], "__init__.pyi").touch()
        stub.write_text("from typing import Any\n\ndef __getattr__(name: str) -> Any: ...\n")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project that has all programs."""
    project = tmp_path_factory.mktemp("programs")
    names = {path.name for path in write_programs(project)}
    assert {"guides_lookup_poses.py", "readme_pose.py", "tutorial_swing.py"} <= names
    write_drivers(project)
    write_notebooks(project)
    assert {"can_motors.py", "notebook_live_lookups.py"} <= {path.name for path in project.glob("*.py")}
    (project / "claims.py").write_text(CLAIMS)
    write_stubs(project / "typings")
    return project


def check(folder: Path, module: str, *arguments: str) -> None:
    command = [sys.executable, "-m", module, *arguments]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr


@pytest.mark.long
def test_programs_notebooks_and_drivers_pass_mypy_strict(folder: Path) -> None:
    (folder / "mypy.ini").write_text("[mypy]\nstrict = True\nmypy_path = typings\nexclude = typings/\n")
    check(folder, "mypy", "--cache-dir", os.devnull, ".")


@pytest.mark.long
def test_programs_notebooks_and_drivers_pass_pyright_strict(folder: Path) -> None:
    settings = {
        "exclude": ["typings"],
        "typeCheckingMode": "strict",
        "reportUnnecessaryTypeIgnoreComment": "error",
    }
    (folder / "pyrightconfig.json").write_text(json.dumps(settings))
    check(folder, "pyright", "--pythonpath", sys.executable)
