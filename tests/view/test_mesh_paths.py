"""MeshPaths: files are found where ROS has them, and what is missing says where it was looked for."""

from __future__ import annotations

from pathlib import Path

import pytest

from zstate.view.geometry.paths import MeshPaths, Missing


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package ``arm`` two folders below the only one that is looked in, with one file."""
    for name in ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"):
        monkeypatch.delenv(name, raising=False)
    mesh = tmp_path / "src" / "repository" / "arm" / "meshes" / "a b.stl"
    mesh.parent.mkdir(parents=True)
    mesh.touch()
    return tmp_path / "src" / "repository" / "arm"


def test_packages_are_found_below_ros_package_path(package, monkeypatch):
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"/nowhere:{package.parents[1]}")
    expected = package / "meshes" / "a b.stl"
    assert MeshPaths().find("package://arm/meshes/a b.stl") == expected
    assert MeshPaths().find("package:///arm/meshes/a%20b.stl") == expected


def test_packages_are_found_in_what_ros_2_has_installed(package, monkeypatch):
    share = package.parents[2] / "install" / "share"
    share.mkdir(parents=True)
    package.rename(share / "arm")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(share.parent))
    assert MeshPaths().find("package://arm/meshes/a b.stl") == share / "arm" / "meshes" / "a b.stl"


def test_packages_are_found_around_the_urdf(package):
    found = MeshPaths(package / "urdf").find("package://arm/meshes/a b.stl")
    assert found == package / "meshes" / "a b.stl"


def test_a_relative_name_starts_at_the_urdf(package):
    assert MeshPaths(package).find("meshes/a b.stl") == package / "meshes" / "a b.stl"
    missing = MeshPaths().find("meshes/a b.stl")
    assert isinstance(missing, Missing)
    assert "means nothing without the folder of its URDF" in missing.reason


def test_a_file_is_found_by_its_uri_and_by_its_path(package):
    file = package / "meshes" / "a b.stl"
    assert MeshPaths().find(file.as_uri()) == file
    assert MeshPaths().find(f"file://{file}") == file
    assert MeshPaths().find(str(file)) == file


def test_nothing_is_fetched_from_elsewhere():
    missing = MeshPaths().find("https://example.org/arm.stl")
    assert isinstance(missing, Missing)
    assert missing.reason.startswith("https:// is not fetched")


def test_what_is_missing_says_where_it_was_looked_for(package, monkeypatch):
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(package.parent))
    missing = MeshPaths().find("package://arm/meshes/c.stl")
    assert isinstance(missing, Missing)
    assert (missing.reason, missing.looked) == ("the package 'arm' has no such file", (str(package),))
    unknown = MeshPaths().find("package://leg/meshes/c.stl")
    assert isinstance(unknown, Missing)
    assert "there is no package 'leg'; put the folder" in unknown.reason
    assert str(package.parent) in unknown.looked
