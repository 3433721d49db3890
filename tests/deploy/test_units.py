from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
from configparser import RawConfigParser
from pathlib import Path
from typing import Any

import pytest
from helpers.deployment import DEPLOY
from helpers.processes import find_free_port

UNITS = sorted(path.name for path in DEPLOY.glob("*.service"))


def unit(name: str) -> RawConfigParser:
    parser = RawConfigParser(strict=True)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read(DEPLOY / name)
    return parser


@pytest.mark.parametrize("name", UNITS)
def test_systemd_accepts_the_unit(name: str, tmp_path):
    if not shutil.which("systemd-analyze"):
        pytest.skip("needs systemd-analyze: apt-get install systemd")
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


@pytest.mark.processes
def test_programs_of_the_units_connect_and_exit_as_expected(spawn: Any, tmp_path):
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    config = tmp_path / "router.json5"
    config.write_text(f'{{ mode: "router", listen: {{ endpoints: ["{endpoint}"] }} }}')
    values = {"${ROBOT_MODEL}": "rrbot", "%i": "r1", "/etc/zstate/router.json5": str(config)}

    def start(name: str) -> Any:
        program, *arguments = shlex.split(unit(name)["Service"]["ExecStart"])
        assert Path(program).name == "zstate"
        code = (
            f"import os; os.environ['ZSTATE_CONNECT'] = {endpoint!r}\n"
            "from zstate.cli.main import main; main()"
        )
        return spawn(code, *(values.get(word, word) for word in arguments))

    router = start("zstate-router.service")
    router.line()
    robot = start("zstate-publish@.service")
    robot.line()
    for name, child in (("zstate-publish@.service", robot), ("zstate-router.service", router)):
        os.kill(child.process.pid, signal.SIGTERM)
        assert str(child.wait()) == unit(name)["Service"]["SuccessExitStatus"]


def test_environment_file_in_the_readme_has_the_variables_of_the_unit():
    text = (DEPLOY / "README.md").read_text()
    environment = text.partition("```ini\n")[2].partition("```")[0]
    assert "ROBOT_MODEL=" in environment
    assert "${ROBOT_MODEL}" in unit("zstate-publish@.service")["Service"]["ExecStart"]
