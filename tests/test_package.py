"""Wheel and sdist, built with the build backend alone, without a network."""

import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def build(kind: str, source: Path, folder: Path) -> Path:
    """The wheel or sdist built from ``source``."""
    code = f"from setuptools import build_meta; build_meta.build_{kind}({str(folder)!r})"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=source, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    (made,) = folder.iterdir()
    return made


def extension(wheel: Path) -> set[str]:
    """The C extension in the wheel; empty if built without a compiler."""
    return {name for name in names_in(wheel) if Path(name).suffix in (".so", ".pyd")}


def names_in(wheel: Path) -> set[str]:
    return set(zipfile.ZipFile(wheel).namelist())


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy to build in, because a build leaves files behind."""
    ignored = shutil.ignore_patterns(".*", "__pycache__", "build", "*.egg-info", "*.so")
    return shutil.copytree(ROOT, tmp_path_factory.mktemp("source") / "zstate", ignore=ignored)


@pytest.fixture(scope="module")
def sdist(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("sdist", source, tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def wheel(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("wheel", source, tmp_path_factory.mktemp("wheel"))


def test_wheel_holds_only_the_code_and_the_robots(wheel: Path):
    code = {path.relative_to(ROOT).as_posix() for path in (ROOT / "zstate").rglob("*.py")}
    robots = {f"zstate/models/{path.name}" for path in (ROOT / "models").iterdir() if path.is_file()}
    shipped = {name for name in names_in(wheel) if ".dist-info/" not in name and name not in extension(wheel)}
    assert shipped == code | robots | {"zstate/py.typed", "zstate/_kernel.pyi"}


def test_wheel_metadata_names_licence_and_command(wheel: Path):
    with zipfile.ZipFile(wheel) as archive:
        texts = {
            Path(name).name: archive.read(name).decode() for name in names_in(wheel) if "dist-info" in name
        }
    assert "zstate = zstate.cli.main:main" in texts["entry_points.txt"]
    assert "License-Expression: Apache-2.0" in texts["METADATA"]
    assert texts["LICENSE"] == (ROOT / "LICENSE").read_text()


def test_wheel_built_from_the_sdist_is_the_same(wheel: Path, sdist: Path, tmp_path: Path):
    shutil.unpack_archive(sdist, tmp_path / "source")
    (source,) = (tmp_path / "source").iterdir()
    assert names_in(build("wheel", source, tmp_path / "wheel")) == names_in(wheel)


def test_wheel_without_a_compiler_lacks_only_the_extension(
    source: Path, wheel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("CC", "no-such-compiler")
    copy = shutil.copytree(source, tmp_path / "source", ignore=shutil.ignore_patterns("build"))
    made = build("wheel", copy, tmp_path / "wheel")
    assert extension(made) == set()
    assert names_in(made) == names_in(wheel) - extension(wheel)


def test_sdist_holds_the_files_of_the_tests(sdist: Path):
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {
        "tests/conftest.py",
        "README.md",
        "CHANGELOG.md",
        "Dockerfile",
        "models/rrbot.urdf",
        "setup.py",
        "zstate/buffer/_kernel.c",
        "zstate/buffer/_kernel/path.h",
    } <= names


def test_changelog_begins_with_this_version():
    import zstate

    versions = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert versions[0] == zstate.__version__


def test_docker_test_stage_runs_the_test_command_of_the_readme():
    (in_docker,) = re.findall(r"^RUN (.* -m pytest)$", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    assert in_docker in (ROOT / "README.md").read_text().splitlines()


def test_dockerignore_covers_gitignore():
    ignored_by_git = {line.strip("/") for line in (ROOT / ".gitignore").read_text().splitlines()}
    ignored_by_docker = {
        line.removeprefix("**/") for line in (ROOT / ".dockerignore").read_text().splitlines()
    }
    assert ignored_by_git <= ignored_by_docker
