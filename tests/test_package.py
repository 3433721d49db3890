"""Wheel and sdist, built with the build backend alone, without a network."""

import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from itertools import chain
from pathlib import Path
from runpy import run_path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent
FILES_ON_GITHUB = (
    r"https://(?:github\.com/zstate/zstate/(?:blob|tree)|raw\.githubusercontent\.com/zstate/zstate)/v1\.0/"
)


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


def ignored_by_git() -> set[str]:
    return {line.strip("/") for line in (ROOT / ".gitignore").read_text().splitlines()}


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy to build in, because a build leaves files behind: the repository without what git ignores."""
    ignored = shutil.ignore_patterns(".git", *(Path(name).name for name in ignored_by_git()))
    return shutil.copytree(ROOT, tmp_path_factory.mktemp("source") / "zstate", ignore=ignored)


@pytest.fixture(scope="module")
def sdist(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("sdist", source, tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def wheel(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("wheel", source, tmp_path_factory.mktemp("wheel"))


@pytest.mark.long
def test_wheel_holds_only_the_code_and_the_robots(wheel: Path):
    code = {path.relative_to(ROOT).as_posix() for path in (ROOT / "zstate").rglob("*.py")}
    robots = {f"zstate/models/{path.name}" for path in (ROOT / "models").iterdir() if path.is_file()}
    shipped = {name for name in names_in(wheel) if ".dist-info/" not in name and name not in extension(wheel)}
    assert shipped == code | robots | {"zstate/py.typed", "zstate/_kernel.pyi"}


@pytest.mark.long
def test_wheel_metadata_names_licence_and_command(wheel: Path):
    with zipfile.ZipFile(wheel) as archive:
        texts = {
            Path(name).name: archive.read(name).decode() for name in names_in(wheel) if "dist-info" in name
        }
    assert "zstate = zstate.cli.main:main" in texts["entry_points.txt"]
    assert "License-Expression: Apache-2.0" in texts["METADATA"]
    assert texts["LICENSE"] == (ROOT / "LICENSE").read_text()


@pytest.mark.long
def test_wheel_built_from_the_sdist_is_the_same(wheel: Path, sdist: Path, tmp_path: Path):
    shutil.unpack_archive(sdist, tmp_path / "source")
    (source,) = (tmp_path / "source").iterdir()
    assert names_in(build("wheel", source, tmp_path / "wheel")) == names_in(wheel)


@pytest.mark.long
def test_wheel_without_a_compiler_lacks_only_the_extension(
    source: Path, wheel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("CC", "no-such-compiler")
    copy = shutil.copytree(source, tmp_path / "source", ignore=shutil.ignore_patterns("build"))
    made = build("wheel", copy, tmp_path / "wheel")
    assert extension(made) == set()
    assert names_in(made) == names_in(wheel) - extension(wheel)


@pytest.mark.long
def test_sdist_holds_every_file_of_the_repository(source: Path, sdist: Path):
    with tarfile.open(sdist) as archive:
        shipped = {one.name.partition("/")[2] for one in archive if one.isfile()}
    built = ("build/", "zstate.egg-info/")
    repository = {path.relative_to(source).as_posix() for path in source.rglob("*") if path.is_file()}
    assert {name for name in repository if not name.startswith(built) and not name.endswith(".so")} <= shipped


def test_changelog_and_citation_name_this_version():
    import zstate

    versions = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert versions[0] == zstate.__version__
    assert f"\nversion: {zstate.__version__}\n" in (ROOT / "CITATION.cff").read_text()


def test_lock_has_a_version_of_each_requirement_within_its_bounds():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    texts = chain(project["dependencies"], *project["optional-dependencies"].values())
    lines = (ROOT / ".ci" / "constraints.txt").read_text().splitlines()
    locked = [Requirement(line) for line in lines if not line.startswith("#")]
    for requirement in map(Requirement, texts):
        name = canonicalize_name(requirement.name)
        versions = [one.version for lock in locked if lock.name == name for one in lock.specifier]
        permitted = list(requirement.specifier.filter(versions))
        assert name == "zstate" or (versions and permitted == versions), (
            f"{requirement}: run the command in the first lines of .ci/constraints.txt"
        )


def test_readme_of_a_release_has_only_absolute_links_and_they_lead_to_files(tmp_path: Path):
    from readme_renderer import markdown

    readme = Path(shutil.copy(ROOT / "README.md", tmp_path))
    subprocess.run([sys.executable, ROOT / ".ci" / "absolute_links.py", "v1.0", readme], check=True)
    page = markdown.render(readme.read_text())
    assert page
    headings = set(re.findall(r'id="user-content-([^"]*)"', page))
    in_repository = []
    for target in re.findall(r'(?:href|src)="([^"]*)"', page):
        if target.startswith("#"):
            assert target.removeprefix("#user-content-") in headings, target
            continue
        assert target.startswith("https://"), f"{target} is relative, which PyPI cannot show"
        in_repository += re.findall(rf"{FILES_ON_GITHUB}([^#]*)(?:#.*)?", target)
    assert len(in_repository) > 10
    assert [path for path in in_repository if not (ROOT / path).exists()] == []


@pytest.mark.robots
def test_licences_page_lists_the_packages_that_zstate_installs():
    required = run_path(str(ROOT / ".ci" / "licences.py"))["required"]
    page = (ROOT / "docs" / "licences.md").read_text()
    rows = dict(re.findall(r"^\| ([a-z0-9-]+) \| ([^|]*) \|", page, re.MULTILINE))
    del rows["package"]
    missing = {name for extra in ((), ("all",), ("mujoco",)) for name in required(extra)} - rows.keys()
    assert missing == set(), "run python .ci/licences.py"
    assert {name: licence for name, licence in rows.items() if licence in ("", "UNKNOWN")} == {}
    lines = (ROOT / ".ci" / "constraints.txt").read_text().splitlines()
    assert rows.keys() <= {Requirement(line).name for line in lines if not line.startswith("#")}


def test_install_page_lists_the_extras_and_the_base_without_pinocchio():
    page = (ROOT / "docs" / "install.md").read_text()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    rows = set(re.findall(r"^\| `(\w+)` \| \d+ \|", page, re.MULTILINE))
    assert rows == set(project["optional-dependencies"]) - {"docs", "lint"}
    (without,) = re.findall(r"^pip install (eclipse-zenoh .*)$", page, re.MULTILINE)
    base = {canonicalize_name(Requirement(text).name) for text in project["dependencies"]}
    assert set(without.split()) == {name for name in base if name != "pin" and not name.startswith("cmeel-")}


def test_docker_test_stage_runs_the_test_command_of_the_readme():
    (in_docker,) = re.findall(
        r"^RUN (.* -m pytest -n auto)$", (ROOT / "Dockerfile").read_text(), re.MULTILINE
    )
    assert in_docker in (ROOT / "README.md").read_text().splitlines()


def test_dockerignore_covers_gitignore():
    ignored_by_docker = {
        line.removeprefix("**/") for line in (ROOT / ".dockerignore").read_text().splitlines()
    }
    assert ignored_by_git() <= ignored_by_docker
