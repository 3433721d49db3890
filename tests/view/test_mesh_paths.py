"""MeshPaths: files are found where ROS keeps them, and only files that the description may use."""

from __future__ import annotations

from pathlib import Path

import pytest

from zstate.model.mesh_paths import MeshPaths, MissingFile


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package ``arm`` with one file, two folders below the search path."""
    for name in ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"):
        monkeypatch.delenv(name, raising=False)
    mesh = tmp_path / "src" / "repository" / "arm" / "meshes" / "a b.stl"
    mesh.parent.mkdir(parents=True)
    mesh.touch()
    (mesh.parents[1] / "package.xml").write_text("<package><name>arm</name></package>")
    return tmp_path / "src" / "repository" / "arm"


def test_packages_are_found_below_ros_package_path(package, monkeypatch):
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"/nowhere:{package.parents[1]}")
    expected = package / "meshes" / "a b.stl"
    assert MeshPaths().find("package://arm/meshes/a b.stl") == expected
    assert MeshPaths().find("package:///arm/meshes/a%20b.stl") == expected


def test_packages_are_found_in_ament_prefix_path(package, monkeypatch):
    share = package.parents[2] / "install" / "share"
    share.mkdir(parents=True)
    package.rename(share / "arm")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(share.parent))
    assert MeshPaths().find("package://arm/meshes/a b.stl") == share / "arm" / "meshes" / "a b.stl"


def test_packages_are_found_in_folders_above_the_urdf(package):
    found = MeshPaths(package / "urdf").find("package://arm/meshes/a b.stl")
    assert found == package / "meshes" / "a b.stl"


def test_relative_path_starts_at_the_urdf(package):
    assert MeshPaths(package).find("meshes/a b.stl") == package / "meshes" / "a b.stl"
    missing = MeshPaths().find("meshes/a b.stl")
    assert isinstance(missing, MissingFile)
    assert "means nothing without the folder of its URDF" in missing.reason


def test_urdf_file_of_the_user_may_name_any_file(package, tmp_path):
    file = package / "meshes" / "a b.stl"
    for uri in (file.as_uri(), f"file://{file}", str(file)):
        assert MeshPaths(tmp_path / "urdf").find(uri) == file


def test_relative_base_folder_has_its_ancestors(package, monkeypatch):
    monkeypatch.chdir(package)
    file = package / "meshes" / "a b.stl"
    assert MeshPaths(Path("urdf")).find("package://arm/meshes/a b.stl") == file
    assert MeshPaths(Path()).find("package://arm/meshes/a b.stl") == file
    assert MeshPaths(Path()).find("meshes/a b.stl") == file
    monkeypatch.setenv("ROS_PACKAGE_PATH", ".")
    assert MeshPaths().find("package://arm/meshes/a b.stl") == file


@pytest.fixture
def outside(package: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file outside all packages on the search path."""
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(package.parent))
    share = package.parents[2] / "install" / "share"
    (share / "leg").mkdir(parents=True)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(share.parent))
    secret = package.parents[2] / "private" / "secret.png"
    secret.parent.mkdir()
    secret.touch()
    (package / "link").symlink_to(secret.parent)
    (package / "loop").symlink_to(package / "loop")
    (package / "secret.png").symlink_to(secret)
    (share / "leg" / "link").symlink_to(secret.parent)
    return secret


@pytest.mark.long
def test_received_description_gets_no_file_outside_packages_and_no_hint_that_it_exists(outside):
    private, package = outside.parent, outside.parents[1] / "src" / "repository" / "arm"

    def answers(file: str) -> list[Path | tuple[str, tuple[str, ...]]]:
        up = "../" * 30
        uris = [
            f"file://{private}/{file}",
            f"{private}/{file}",
            f"file://localhost{private}/{file}",
            f"file://{package}/../../../private/{file}",
            f"package://arm/../../../private/{file}",
            f"package://arm/%2e%2e/../../private/{file}",
            f"package://arm/meshes/{up}{private}/{file}",
            f"package://arm/{private}/{file}",
            f"package:////{private}/{file}",
            f"package://../{private.name}/{file}",
            f"package://./private/{file}",
            f"package://..{private}/{file}",
            f"package://arm/link/{file}",
            f"package://leg/link/{file}",
            f"package://arm/loop/{file}",
            f"file://{package}/link/{file}",
            f"model://arm/link/{file}",
            f"../private/{file}",
            file,
        ]
        found = [MeshPaths().find(uri) for uri in uris]
        return [(one.reason, one.searched) if isinstance(one, MissingFile) else one for one in found]

    present, absent = answers("secret.png"), answers("nothing.png")
    assert [one for one in present if isinstance(one, Path)] == []
    assert present == absent
    linked = MeshPaths().find("package://arm/secret.png")
    assert isinstance(linked, MissingFile)
    assert linked.reason == "it leads out of the package 'arm'"


def test_folders_without_a_package_xml_are_no_packages_of_a_received_description(package, monkeypatch):
    """A link below the search path may lead anywhere: to /etc, or to the user's pictures."""
    workspace, private = package.parents[1], package.parents[2] / "private"
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(workspace))
    share = package.parents[2] / "install" / "share"
    share.mkdir(parents=True)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(share.parent))
    private.mkdir()
    for folder in (private, workspace, workspace / "repository"):
        (folder / "secret.stl").touch()
    for link in (package / "pictures", workspace / "pictures", share / "pictures"):
        link.symlink_to(private)
    for uri in (
        "package://pictures/secret.stl",
        f"package://{workspace.name}/secret.stl",
        "package://repository/secret.stl",
        f"{workspace}/secret.stl",
        f"{workspace}/pictures/secret.stl",
        f"{workspace}/repository/secret.stl",
        f"{package}/pictures/secret.stl",
        f"file://{share}/pictures/secret.stl",
    ):
        assert isinstance(MeshPaths().find(uri), MissingFile), uri
    # The URDF that the user names may use all of them.
    assert MeshPaths(package).find("package://pictures/secret.stl") == package / "pictures" / "secret.stl"


def test_package_behind_a_link_of_a_workspace_is_found(package, monkeypatch):
    workspace = package.parents[2] / "workspace"
    workspace.mkdir()
    (workspace / "arm").symlink_to(package)
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(workspace))
    expected = workspace / "arm" / "meshes" / "a b.stl"
    assert MeshPaths().find("package://arm/meshes/a b.stl") == expected
    assert MeshPaths().find(str(expected)) == expected


def test_received_description_may_name_a_file_of_a_package_by_its_path(package, outside):
    file = package / "meshes" / "a b.stl"
    assert MeshPaths().find(str(file)) == file
    assert MeshPaths().find(file.as_uri()) == file


def test_links_to_the_sources_of_the_same_package_are_followed(package, monkeypatch):
    """As colcon installs them with --symlink-install."""
    file = package / "meshes" / "a b.stl"
    installed = package.parents[2] / "install" / "share" / "arm" / "meshes" / "a b.stl"
    installed.parent.mkdir(parents=True)
    installed.symlink_to(file)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(installed.parents[3]))
    (package / "package.xml").unlink()
    assert isinstance(MeshPaths().find("package://arm/meshes/a b.stl"), MissingFile)
    (package / "package.xml").write_text("<package><name>leg</name></package>")
    assert isinstance(MeshPaths().find("package://arm/meshes/a b.stl"), MissingFile)
    (package / "package.xml").write_text("<package><name> arm </name></package>")
    assert MeshPaths().find("package://arm/meshes/a b.stl") == installed
    assert MeshPaths().find(str(installed)) == installed


def test_network_uris_are_not_fetched():
    missing = MeshPaths().find("https://example.org/arm.stl")
    assert isinstance(missing, MissingFile)
    assert missing.reason.startswith("https:// is not fetched")


def test_missing_file_lists_the_searched_folders(package, monkeypatch):
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(package.parent))
    missing = MeshPaths().find("package://arm/meshes/c.stl")
    assert isinstance(missing, MissingFile)
    assert (missing.reason, missing.searched) == ("the package 'arm' has no such file", (str(package),))
    unknown = MeshPaths().find("package://leg/meshes/c.stl")
    assert isinstance(unknown, MissingFile)
    assert "there is no package 'leg'; put its folder" in unknown.reason
    assert str(package.parent) in unknown.searched
