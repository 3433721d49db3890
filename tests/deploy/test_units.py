from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
from configparser import RawConfigParser
from pathlib import Path
from typing import Any

import pytest
from helpers.cli_runner import published_robot, run_cli
from helpers.deployment import DEPLOY
from helpers.processes import DEADLINE_S, Child, find_free_port, until
from helpers.programs import router
from helpers.systemd import SystemManager

from zstate import connect
from zstate.driving import Commander
from zstate.driving.messages import DriverState
from zstate.recording.info import read_info

UNITS = sorted(path.name for path in DEPLOY.glob("*.service"))


def unit(name: str) -> RawConfigParser:
    parser = RawConfigParser(strict=True)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read(DEPLOY / name)
    return parser


@pytest.mark.systemd
@pytest.mark.parametrize("name", UNITS)
def test_systemd_accepts_the_unit(name: str, tmp_path):
    program = tmp_path / "zstate"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    copy = tmp_path / name
    copy.write_text((DEPLOY / name).read_text().replace("/opt/zstate/bin/zstate", str(program)))
    command = ["systemd-analyze", "verify", "--man=no", str(copy)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")


@pytest.mark.parametrize("name", UNITS)
def test_unit_restarts_and_has_few_permissions(name: str):
    service = unit(name)["Service"]
    assert service["Restart"] == "always"
    assert service["ProtectSystem"] == "strict"
    assert service["NoNewPrivileges"] == "true"


@pytest.mark.parametrize(
    "name",
    ["zstate-router.service", "zstate-publish@.service", "zstate-drive@.service", "zstate-up@.service"],
)
def test_a_program_that_exits_is_restarted_after_one_second(name: str):
    assert unit(name)["Service"]["RestartSec"] == "1"


def test_a_recording_has_a_part_every_500_mb():
    assert "--split-size 500 " in unit("zstate-record.service")["Service"]["ExecStart"]


@pytest.mark.parametrize("name", ["zstate-drive@.service", "zstate-up@.service"])
def test_a_unit_with_drivers_may_open_devices_and_keeps_the_stops(name: str):
    service = unit(name)["Service"]
    assert service["PrivateDevices"] == "false"
    assert "ProtectClock" not in service, "it allows one device, and by that no other"
    assert "AF_CAN" in service["RestrictAddressFamilies"].split()
    assert (service["RestrictRealtime"], service["LimitRTPRIO"]) == ("false", "50")
    assert service["SupplementaryGroups"] == "dialout"
    # Stops are in $XDG_STATE_HOME/zstate, which systemd makes for the unit's user.
    assert service["Environment"] == "XDG_STATE_HOME=/var/lib"
    assert service["StateDirectory"] == "zstate"


@pytest.mark.processes
def test_programs_of_the_units_connect_and_exit_as_expected(spawn: Any, tmp_path):
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    config = tmp_path / "router.json5"
    config.write_text(f'{{ mode: "router", listen: {{ endpoints: ["{endpoint}"] }} }}')
    values = {
        "${ROBOT_MODEL}": "rrbot",
        "${ROBOT_DRIVER}": "sim",
        "%i": "r1",
        "/etc/zstate/router.json5": str(config),
    }
    values |= {"$DRIVE_OPTIONS": "--plant=mirror"}

    def start(name: str) -> Any:
        program, *arguments = shlex.split(unit(name)["Service"]["ExecStart"])
        assert Path(program).name == "zstate"
        code = (
            f"import os; os.environ['ZSTATE_CONNECT'] = {endpoint!r}\n"
            "from zstate.cli.main import main; main()"
        )
        return spawn(code, *(values.get(word, word) for word in arguments))

    routing = start("zstate-router.service")
    routing.line()
    robot = start("zstate-publish@.service")
    robot.line()
    ends = [("zstate-publish@.service", robot), ("zstate-router.service", routing)]
    for name, child in ends:
        if child is routing:
            driver = start("zstate-drive@.service")
            driver.line()
            os.kill(driver.process.pid, signal.SIGTERM)
            assert str(driver.wait()) == unit("zstate-drive@.service")["Service"]["SuccessExitStatus"]
        os.kill(child.process.pid, signal.SIGTERM)
        assert str(child.wait()) == unit(name)["Service"]["SuccessExitStatus"]


@pytest.mark.processes
def test_recorder_that_is_killed_and_started_again_makes_a_second_file(spawn: Any, tmp_path: Path):
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    service = unit("zstate-record.service")["Service"]
    assert service["WorkingDirectory"] == f"/var/lib/{service['StateDirectory']}"
    arguments = shlex.split(service["ExecStart"])[1:]
    code = (
        "import os, sys; os.chdir(sys.argv.pop())\n"
        f"os.environ['ZSTATE_CONNECT'] = {endpoint!r}\n"
        "from zstate.cli.main import main; main()"
    )

    def start() -> Child:
        values = {"${KEEP_RECORDINGS}": "50GB"}
        return spawn(code, *(values.get(word, word) for word in arguments), str(tmp_path))

    def record() -> Child:
        recorder = start()
        until(lambda: recorder.line().endswith("  rrbot"))
        return recorder

    with router(endpoint), published_robot(router=endpoint):
        record().kill()
        (first,) = tmp_path.iterdir()
        before = first.read_bytes()
        recorder = record()
        os.kill(recorder.process.pid, signal.SIGTERM)
        assert str(recorder.wait()) == service["SuccessExitStatus"]
    assert first.read_bytes() == before
    assert read_info(first).robots == ("rrbot",)
    (second,) = set(tmp_path.iterdir()) - {first}
    assert re.fullmatch(r"rec-\d{8}-\d{6}\.mcap", second.name)
    assert read_info(second).complete


@pytest.mark.parametrize(
    ("name", "variable"),
    [("zstate-publish@.service", "ROBOT_MODEL"), ("zstate-record.service", "KEEP_RECORDINGS")],
)
def test_environment_files_in_the_readme_have_the_variables_of_the_units(name: str, variable: str):
    text = (DEPLOY / "README.md").read_text()
    environments = re.findall(r"```ini\n(.*?)```", text, re.DOTALL)
    assert f"${{{variable}}}" in unit(name)["Service"]["ExecStart"]
    assert sum(f"{variable}=" in environment for environment in environments) == 1


@pytest.fixture
def manager(tmp_path: Path) -> SystemManager:
    return SystemManager(tmp_path)


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{find_free_port()}"


def restarted_driver(commander: Commander, before: DriverState) -> DriverState:
    """The first state of the driver that follows that of ``before``, once its loop runs."""

    def runs() -> bool:
        driver = commander.driver
        return driver is not None and driver.session != before.session and driver.state != "off"

    until(runs)
    return commander.wait_for_driver()


@pytest.mark.booted
def test_systemd_starts_a_killed_driver_again_which_stays_stopped_until_the_release(
    manager: SystemManager, endpoint: str
):
    (manager.etc / "zstate/r1.env").write_text(
        f"ROBOT_DRIVER=sim\nROBOT_MODEL=rrbot\nDRIVE_OPTIONS=--plant=mirror\nZSTATE_CONNECT={endpoint}\n"
    )
    name = "zstate-drive@r1.service"
    with (
        router(endpoint),
        manager,
        connect(mode="client", endpoints=endpoint) as session,
        Commander(session, "r1") as commander,
    ):
        manager.systemctl("start", name)
        first = commander.wait_for_driver(DEADLINE_S)
        assert run_cli("stop", "r1", "--reason", "door", "--connect", endpoint).code == 0
        manager.systemctl("kill", "--signal=KILL", name)
        second = restarted_driver(commander, first)
        assert (manager.property(name, "NRestarts"), second.state) == ("1", "stopped")
        commander.release(DEADLINE_S)
        until(lambda: commander.driver is not None and commander.driver.state == "ready")
        manager.systemctl("stop", name)
        assert manager.property(name, "Result") == "success"


@pytest.mark.booted
def test_systemd_ends_and_restarts_a_cell_with_all_its_processes(manager: SystemManager, endpoint: str):
    (manager.etc / "zstate/hall.toml").write_text(
        f'[router]\nlisten = ["{endpoint}"]\n[network]\nmode = "client"\nconnect = ["{endpoint}"]\n'
        '[[drive]]\ndriver = "sim"\nrobot = "rrbot"\nname = "r1"\nplant = "mirror"\n'
        '[[record]]\nfile = "/var/lib/zstate/%Y%m%d-%H%M%S.mcap"\n'
    )
    name = "zstate-up@hall.service"
    with manager:
        manager.systemctl("start", name)
        with (
            connect(mode="client", endpoints=endpoint, timeout_s=DEADLINE_S) as session,
            Commander(session, "r1") as commander,
        ):
            first = commander.wait_for_driver(DEADLINE_S)
            manager.systemctl("kill", "--kill-whom=main", "--signal=KILL", name)
            second = restarted_driver(commander, first)
            assert (manager.property(name, "NRestarts"), second.state) == ("1", "ready")
        manager.systemctl("stop", name)
        assert manager.property(name, "Result") == "success"
        last = max((manager.state / "zstate").glob("*.mcap"))
        assert read_info(last).complete
