from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from looking import RRBOT, Spawn, failure, interrupted, started
from support import Child

from zstate import TransformListener, connect, discover

pytestmark = pytest.mark.processes

STATIC = '[[static]]\ntarget = "lower"\nsource = "flange"\nxyz = [0, 0, 1]\nrpy_deg = [0, 0, 0]\n'


def robot(**settings: object) -> str:
    return "[[robot]]\n" + "".join(f"{key} = {value!r}\n" for key, value in settings.items())


@pytest.fixture
def up(spawn: Spawn, tmp_path: Path):
    def start(text: str) -> Child:
        return started(spawn, "up", str(file_of(tmp_path, text)))

    return start


def file_of(folder: Path, text: str) -> Path:
    file = folder / "cell.toml"
    file.write_text(text)
    return file


def lines_until(child: Child, *wanted: str) -> list[str]:
    lines: list[str] = []
    while not all(any(text in line for line in lines) for text in wanted):
        lines.append(child.line())
    return lines


def test_robots_and_statics_of_one_file_run_until_ctrl_c(up):
    child = up(robot(model=RRBOT, name="left", source="sine", rate=50.0) + STATIC)
    lines = lines_until(child, "publishing 'left'", "pose of flange in lower")
    assert {line.partition(" | ")[0].strip() for line in lines} == {"left", "static"}
    with connect() as session, TransformListener(session, "left") as listener:
        assert listener.buffer.wait("base", "flange", timeout_s=10.0).source == "flange"
    interrupted(child)


def test_with_a_router_everything_meets_at_it(up, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    child = up(f'[router]\nlisten = ["{endpoint}"]\n' + robot(model=RRBOT, source="sine"))
    lines_until(child, "listens at", "publishing 'rrbot'")
    with connect(mode="client", endpoints=endpoint) as session, TransformListener(session) as listener:
        assert listener.buffer.wait("base", "lower", timeout_s=10.0).kind == "exact"
    interrupted(child)


def test_a_part_that_dies_ends_all_with_its_last_error(up):
    child = up(robot(model=RRBOT, name="one", source="sine") + robot(model=RRBOT, name="two", source="sine"))
    lines_until(child, "publishing 'one'", "publishing 'two'")
    with connect() as session:
        pids = {info.name: info.writers[0][1].pid for info in discover(session)}
    os.kill(pids["two"], signal.SIGKILL)
    assert child.wait() == 1
    assert "zstate: 'two' ended with exit code -9" in child.stderr
    with pytest.raises(ProcessLookupError):
        os.kill(pids["one"], 0)


def test_the_last_error_of_a_part_is_the_cause_that_is_told(up, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with connect(listen=endpoint):
        child = up(f"[network]\nlisten = ['{endpoint}']\n" + robot(model=RRBOT))
        assert child.wait() == 1
    assert f"'rrbot' ended with exit code 1: zstate: somebody listens at {endpoint!r}" in child.stderr


def test_models_are_found_beside_the_file(tmp_path: Path, up):
    (tmp_path / "arm.urdf").write_text(Path(RRBOT).read_text())
    lines_until(up(robot(model="./arm.urdf", source="sine")), "publishing 'rrbot'")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "starts nothing"),
        ("[[robot]\n", "line 1"),
        ("[router]\nlisen = []\n", "router: Object contains unknown field `lisen`; did you mean 'listen'?"),
        ("[network]\nconnect = ['10.0.0.1']\n", "network: '10.0.0.1' is not an endpoint"),
        ("[network]\nmode = 'client'\n", "network: mode 'client' needs connect"),
        (robot(model="rrbott"), "robot[0]: no robot is called 'rrbott', did you mean 'rrbot'"),
        (robot(model=RRBOT, rate=0), "robot[0]: a rate is above 0"),
        (robot(model=RRBOT) + robot(model=RRBOT), "robot[1]: robot[0] is called 'rrbot' already"),
        (robot(model=RRBOT, name="a b"), "robot[0]: the robot name 'a b' contains ' '"),
        (robot(model=RRBOT, source="file"), "robot[0].source"),
        (STATIC, "static[0]: whose edge is this?"),
        (robot(model=RRBOT) + STATIC.replace("rpy_deg", "rpy_rad"), "unknown field `rpy_rad`"),
        (robot(model=RRBOT) + STATIC.replace("[0, 0, 1]", "[0, 0]"), "static[0].xyz"),
        (robot(model=RRBOT) + STATIC.replace("flange", "lower"), "itself"),
        (robot(model=RRBOT) + STATIC.partition("xyz")[0], "'flange' in 'lower' has 0 rotations and no xyz"),
    ],
)
def test_a_file_that_cannot_be_used_is_told_with_the_place_in_it(tmp_path: Path, text: str, told: str):
    message = failure("up", str(file_of(tmp_path, text)))
    assert told in message
    assert "cell.toml" in message
