"""load_model and the catalog: names, paths, text, and the errors of missing ones."""

import os
import subprocess
import sys
import threading
from importlib import metadata
from pathlib import Path

import pytest
from helpers.robots import RRBOT

from zstate.errors import InvalidInput, ModelError, UnknownModel
from zstate.model import catalog
from zstate.model.load import load_model

TEXT = '<robot name="one"><link name="only"/></robot>'


def test_text_bytes_paths_and_names_are_distinguished(tmp_path: Path):
    path = tmp_path / "one.urdf"
    path.write_text(TEXT)
    assert load_model(TEXT) == load_model(TEXT.encode()) == load_model(path) == load_model(str(path))
    assert load_model("rrbot").name == "rrbot"


def test_a_bare_file_name_is_a_path_when_the_file_exists(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "onefile").write_text(TEXT)
    monkeypatch.chdir(tmp_path)
    assert load_model("onefile").name == "one"


@pytest.fixture
def pipe(tmp_path: Path) -> Path:
    path = tmp_path / "arm.urdf"
    os.mkfifo(path)
    return path


def test_a_pipe_is_read_to_its_end(pipe: Path):
    """As of `zstate check <(xacro arm.xacro)`, whose parts come later."""
    text = RRBOT.urdf.encode()

    def write() -> None:
        with pipe.open("wb", buffering=0) as file:
            for part in (text[:100], text[100:]):
                file.write(part)

    writer = threading.Thread(target=write)
    writer.start()
    model = load_model(pipe)
    writer.join()
    assert model.joint_names == RRBOT.joint_names


def test_a_pipe_of_the_shell_and_standard_input_are_read(tmp_path: Path):
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(RRBOT.urdf)
    program = "import sys; from zstate import load_model; print(len(load_model(sys.argv[1]).joint_names))"
    for command in ('"$1" -c "$2" <(cat "$3")', 'cat "$3" | "$1" -c "$2" /dev/stdin'):
        arguments = ["bash", "-c", command, "bash", sys.executable, program, str(urdf)]
        done = subprocess.run(arguments, check=False, capture_output=True, text=True, timeout=60)
        assert (done.stdout, done.stderr) == ("2\n", "")


def test_a_pipe_without_a_writer_is_refused(pipe: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("zstate.model.load._SILENT_S", 0.1)
    with pytest.raises(ModelError, match=r"nothing has been written to this pipe for 0\.1 s"):
        load_model(pipe)


def test_a_folder_does_not_hide_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "rrbot").mkdir()
    monkeypatch.chdir(tmp_path)
    assert load_model("rrbot").name == "rrbot"


@pytest.mark.parametrize("missing", ["gone.urdf", "gone.xacro", "./gone", Path("gone")])
def test_a_missing_file_is_an_error_with_its_path(
    missing: str | Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ModelError, match="there is no such file") as caught:
        load_model(missing)
    assert caught.value.source == str(missing)
    assert f"no such file in {tmp_path}" in str(caught.value)  # the folder that a relative path starts from


def test_the_findings_have_the_path_as_passed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    Path("bad.urdf").write_text("<robot/>")
    with pytest.raises(ModelError, match=r"^bad.urdf cannot be used \(1 finding\)\n  line 1  "):
        load_model("bad.urdf")


def test_folders_and_files_beyond_the_limit_are_refused(tmp_path: Path):
    with pytest.raises(ModelError, match=r"directory; name the .urdf file in it"):
        load_model(tmp_path)
    huge = tmp_path / "huge.urdf"
    with huge.open("wb") as file:
        file.truncate(16 * 2**20 + 1)
    with pytest.raises(ModelError, match="more than 16777216 bytes"):
        load_model(huge)
    with pytest.raises(ModelError, match="cannot be read"):
        load_model("zero\0byte.urdf")


def test_an_unknown_name_has_near_misses_and_the_searched_collections():
    with pytest.raises(UnknownModel) as caught:
        load_model("rrbott")
    assert caught.value.name == "rrbott"
    assert caught.value.near_misses[0] == "rrbot"
    assert "no robot is called 'rrbott'; did you mean 'rrbot'" in str(caught.value)
    assert "looked in zstate (" in str(caught.value)


def test_without_example_robot_data_the_error_names_the_extra_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    def absent(name: str) -> metadata.Distribution:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "distribution", absent)
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    catalog._example_robot_data.cache_clear()
    try:
        with pytest.raises(UnknownModel, match=r"pip install 'zstate\[robots\]'"):
            load_model("panda")
    finally:
        catalog._example_robot_data.cache_clear()


def test_every_entry_of_the_catalog_is_a_file_of_its_name():
    entries = catalog.catalog()
    assert [entry.name for entry in entries] == sorted({entry.name for entry in entries})
    assert all(entry.path.is_file() for entry in entries)
    assert {"rrbot", "diffbot", "gripper"} <= {entry.name for entry in entries if entry.origin == "zstate"}


@pytest.mark.robots
@pytest.mark.parametrize(
    ("name", "robot", "velocities"),
    [
        ("panda", "panda", 8),
        ("Panda_description", "panda", 8),
        ("ur5", "ur5", 6),
        ("ur3", "ur3", 6),
        ("g1", "g1_29dof_rev_1_0", 29),
        ("talos_full", "talos", 44 - 12),
        ("solo12", "solo", 12),
    ],
)
def test_common_names_are_known(name: str, robot: str, velocities: int):
    model = load_model(name)
    assert (model.name, model.velocity_count) == (robot, velocities)


def test_clones_of_robot_descriptions_are_found_in_its_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    package = tmp_path / "site" / "robot_descriptions"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('importing it may clone')")
    clone = tmp_path / "cache" / "arms" / "urdf"
    clone.mkdir(parents=True)
    (clone / "cached_arm.urdf").write_text(TEXT)
    monkeypatch.syspath_prepend(str(package.parent))
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path / "cache"))
    catalog._robot_descriptions.cache_clear()
    try:
        assert load_model("cached_arm").name == "one"
    finally:
        catalog._robot_descriptions.cache_clear()


def test_loading_a_model_imports_neither_pinocchio_nor_zenoh():
    code = (
        "import sys; from zstate.model.load import load_model; load_model('rrbot');"
        "print({'pinocchio', 'zenoh', 'cmeel', 'xacro'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_xacro_arguments_for_a_file_without_xacro_are_refused():
    with pytest.raises(
        InvalidInput, match="'URDF text' contains no xacro, so it takes no xacro arguments; got length:=1"
    ):
        load_model(TEXT, xacro_args={"length": "1"})


def test_the_robot_of_examples_is_installed(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(catalog, "_COLLECTIONS", {"zstate": catalog._bundled})
    assert catalog.example_name() == "rrbot"
    monkeypatch.setattr(
        catalog, "_COLLECTIONS", {"zstate": catalog._bundled, "more": lambda: {"panda": Path("p")}}
    )
    assert catalog.example_name() == "panda"
