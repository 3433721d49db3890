from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path

import pytest
from helpers.cli_runner import RRBOT, Spawn, failure, interrupted, run_cli, started
from helpers.processes import Child, until

from zstate import TransformListener, connect, discover
from zstate.cli.commands.up import up_command
from zstate.scans import Grid

STATIC = '[[static]]\ntarget = "lower"\nsource = "flange"\nxyz = [0, 0, 1]\nrpy_deg = [0, 0, 0]\n'


def robot(**settings: object) -> str:
    return table("robot", **{"model": RRBOT, "source": "sine", **settings})


def table(kind: str, **settings: object) -> str:
    return f"[[{kind}]]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in settings.items())


@pytest.fixture
def up(spawn: Spawn, tmp_path: Path):
    def start(text: str, *arguments: str) -> Child:
        return started(spawn, "up", str(file_of(tmp_path, text)), *arguments)

    return start


def file_of(folder: Path, text: str) -> Path:
    file = folder / "cell.toml"
    file.write_text(text)
    return file


def lines_until(child: Child, *texts: str) -> list[str]:
    lines: list[str] = []
    while not all(any(text in line for line in lines) for text in texts):
        lines.append(child.line())
    return lines


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def printed_pid(child: Child, name: str) -> int:
    (line,) = lines_until(child, name)[-1:]
    return int(line.split()[-1])


@pytest.mark.processes
def test_robots_and_statics_of_one_file_run_until_ctrl_c(up):
    child = up(robot(name="left", rate=50.0) + STATIC)
    lines = lines_until(child, "publishing 'left'", "pose of flange in lower")
    assert {line.partition(" | ")[0].strip() for line in lines} == {"left", "static"}
    with connect() as session, TransformListener(session, "left") as listener:
        assert listener.buffer.wait("base", "flange", timeout_s=10.0).source == "flange"
    interrupted(child)


@pytest.mark.processes
def test_plain_python_program_connects_to_the_router_of_the_file(up, free_port: int):
    program = "\n".join(
        [
            "import zstate",
            "with zstate.connect() as session, zstate.TransformListener(session, 'left') as listener:",
            "    print('received', listener.buffer.wait('base', 'lower', timeout_s=10.0).source)",
        ]
    )
    child = up(
        f'[router]\nlisten = ["tcp/127.0.0.1:{free_port}"]\n'
        + robot(name="left")
        + table("program", name="mine", run=["python", "-c", program], after=["left"])
    )
    assert any(line.startswith("mine") for line in lines_until(child, "received lower"))
    interrupted(child)


@pytest.mark.processes
def test_a_loop_starts_a_robot_for_each_name_with_its_own_static_edges(up):
    child = up(
        "[parameters]\nrate = 100.0\n"
        + robot(names=["left", "right"], rate="${rate}", when="${name} != right")
        + robot(count=2, name="arm${number}", rate="${rate}")
        + STATIC
        + 'robot = "arm*"\n',
        "rate=50",
    )
    lines_until(child, "publishing 'left'", "'arm1'", "'arm2'", "robot 'arm1'", "robot 'arm2'")
    with connect() as session:
        until(lambda: [info.name for info in discover(session)] == ["arm1", "arm2", "left"])
        with TransformListener(session, "*") as listener:
            assert listener.buffer.wait("arm2/base", "arm2/flange", timeout_s=10.0)
    interrupted(child)


@pytest.mark.processes
def test_all_parts_connect_to_the_router_of_the_file(up, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    child = up(f'[router]\nlisten = ["{endpoint}"]\n' + robot())
    lines_until(child, "listens at", "publishing 'rrbot'")
    with connect(mode="client", endpoints=endpoint) as session, TransformListener(session) as listener:
        assert listener.buffer.wait("base", "lower", timeout_s=10.0).kind == "exact"
    interrupted(child)


@pytest.mark.processes
def test_certificates_of_the_file_encrypt_connections_to_its_router(up, free_port: int, tmp_path: Path):
    assert run_cli("certs", str(tmp_path / "fleet"), "--identity", "router", "--identity", "rrbot").code == 0
    endpoint = f"tls/127.0.0.1:{free_port}"
    child = up(
        f'[router]\nlisten = ["{endpoint}"]\ncerts = "fleet"\nidentity = "router"\n'
        '[network]\ncerts = "fleet"\n' + robot(identity="rrbot")
    )
    lines = lines_until(child, "publishing 'rrbot'")
    assert endpoint in lines[0]
    interrupted(child)


@pytest.mark.processes
def test_a_part_that_dies_ends_all_with_its_last_error(up):
    child = up(robot(name="one") + robot(name="two"))
    lines_until(child, "publishing 'one'", "publishing 'two'")
    with connect() as session:
        pids = {info.name: info.writers[0][1].pid for info in discover(session)}
    os.kill(pids["two"], signal.SIGKILL)
    assert child.wait() == 1
    assert "zstate: 'two' ended with exit code -9" in child.stderr
    assert not is_alive(pids["one"])


@pytest.mark.processes
def test_part_with_restarts_is_restarted_and_the_others_continue(up):
    child = up(
        table("program", name="shell", run=["sh", "-c", "echo at $$; exec sleep 60"], restart="on-failure")
    )
    first = printed_pid(child, "at")
    os.kill(first, signal.SIGKILL)
    assert printed_pid(child, "at") != first
    interrupted(child)
    assert "'shell' ended with exit code -9: it printed no error; it starts again in 0.5 s" in child.stderr


@pytest.mark.processes
def test_last_error_of_a_process_is_reported_as_the_cause(up, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with connect(listen=endpoint):
        child = up(f"[network]\nlisten = ['{endpoint}']\n" + robot())
        assert child.wait() == 1
    assert f"'rrbot' ended with exit code 1: zstate: another program listens at {endpoint!r}" in child.stderr


@pytest.mark.processes
def test_error_of_several_lines_is_reported_in_full(up):
    script = "echo Trouble >&2; echo 'Bad: a file' >&2; echo '  line 3  it has no end' >&2; exit 3"
    child = up(table("program", name="driver", run=["sh", "-c", script]))
    assert child.wait() == 1
    assert "'driver' ended with exit code 3: Bad: a file line 3  it has no end\n" in child.stderr


@pytest.mark.processes
def test_program_starts_when_its_dependency_is_ready(up):
    child = up(
        table("program", name="late", run=["echo", "now"], after=["slow", "rrbot"])
        + table(
            "program",
            name="slow",
            run=["sh", "-c", "echo not yet; echo it runs; exec sleep 60"],
            ready="it runs",
        )
        + robot()
    )
    lines = lines_until(child, "| now")
    assert any("it runs" in line for line in lines[:-1])
    assert any("publishing 'rrbot'" in line for line in lines[:-1])
    interrupted(child)


@pytest.mark.processes
def test_up_succeeds_when_every_part_has_finished(up):
    child = up(table("program", run=["sh", "-c", "exit 0"]) + table("program", run="zstate check rrbot"))
    assert child.wait() == 0


@pytest.mark.processes
def test_processes_end_before_the_ones_they_need(up):
    # Blocked before the line is printed: a trap of a shell may miss a signal just before its `wait`.
    waits = (
        "import signal; ends = {signal.SIGINT}; signal.pthread_sigmask(signal.SIG_BLOCK, ends); "
        "print('NAME runs', flush=True); signal.sigwait(ends); print('NAME ends', flush=True)"
    )
    base, top = ([sys.executable, "-c", waits.replace("NAME", name)] for name in ("base", "top"))
    child = up(
        table("program", name="base", run=base, ready="runs")
        + table("program", name="top", run=top, after="base", ready="runs")
    )
    lines_until(child, "top runs")
    interrupted(child)
    assert [line.split("| ")[1] for line in (child.line(), child.line())] == ["top ends", "base ends"]


@pytest.mark.processes
def test_programs_end_with_up_however_it_ends(up):
    child = up(table("program", run=["sh", "-c", "echo at $$; exec sleep 60"]))
    pid = printed_pid(child, "at")
    child.kill()
    until(lambda: not is_alive(pid))


@pytest.mark.processes
def test_leftover_children_and_programs_that_ignore_signals_are_killed(up):
    """Else a second driver would come to the same arm when it is started again."""
    deaf = "trap '' INT TERM; sleep 60 & echo at $!; echo at $$; sleep 60"
    child = up(table("program", run=["sh", "-c", deaf]))
    pids = [printed_pid(child, "at"), printed_pid(child, "at")]
    child.kill()
    until(lambda: not any(map(is_alive, pids)))


@pytest.mark.processes
def test_a_line_without_an_end_is_cut(up):
    code = "import sys, time; [sys.stdout.write('x' * 65536) for _ in range(100)]; print()"
    code += "; print('after', flush=True); time.sleep(60)"
    child = up(table("program", name="loud", run=["python3", "-c", code]))
    line, after = child.line(), child.line()
    assert "x" * 65536 + " ... (cut at 65536 characters)" in line
    assert len(line) < 66_000
    assert after.endswith("after")
    interrupted(child)


@pytest.mark.processes
def test_paths_are_relative_to_the_file(tmp_path: Path, up):
    (tmp_path / "arm.urdf").write_text(Path(RRBOT).read_text())
    (tmp_path / "robots.toml").write_text(robot(model="arm.urdf", name="${arm}"))
    lines_until(up("include = 'robots.toml'\n[parameters]\narm = 'left'\n"), "publishing 'left'")


def test_a_file_that_several_include_is_read_once(tmp_path: Path):
    """Else 24 files that each include the next one twice would be read 16 million times."""
    for number in range(24):
        (tmp_path / f"part_{number}.toml").write_text(f"include = {[f'part_{number + 1}.toml'] * 2}\n")
    (tmp_path / "part_24.toml").write_text(robot())
    shown = run_cli("up", str(tmp_path / "part_0.toml"), "--check")
    assert [line.split()[0] for line in shown.stdout.splitlines()] == ["rrbot"], shown.stderr


def test_check_prints_the_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SPEED", "20")
    text = robot(rate="${SPEED}", wires=["native", "ros2"], metrics=9100, takeover=True, restart="always")
    shown = run_cli("up", str(file_of(tmp_path, text)), "--check").stdout.split()
    assert shown[:3] == ["rrbot", "zstate", "publish"]
    assert " ".join(shown).endswith(
        "--source sine --rate 20 --wire native --wire ros2 --takeover --metrics 9100"
    )


def test_check_prints_the_commands_of_maps_and_scanners(tmp_path: Path):
    Grid([[0, 100]], 0.1, (0.0, 0.0, 0.0)).save(tmp_path / "hall.yaml")
    text = table("map", file="hall.yaml", frame="floor")
    text += table("map", file="hall.yaml", name="r1", writer="slam", wires=["native", "ros2"])
    text += table("scan", robot="r1", frame="laser", simulate="hall.yaml", map_frame="hall/floor", rate=10)
    text += table("scan", robot="r1", frame="laser", dummy=True, sensor="front", after="r1/scan")
    shown = run_cli("up", str(file_of(tmp_path, text)), "--check").stdout.splitlines()
    file = tmp_path / "hall.yaml"
    assert [" ".join(line.split()) for line in shown] == [
        f"hall/map zstate map {file} --frame floor",
        f"r1/slam zstate map {file} --name r1 --writer slam --wire native --wire ros2",
        f"r1/scan zstate scan r1 --frame laser --simulate {file} --map-frame hall/floor --rate 10",
        "r1/front zstate scan r1 --frame laser --dummy --sensor front",
    ]


@pytest.mark.processes
def test_map_and_a_scanner_in_it_run(up, tmp_path: Path):
    Grid([[0, 100]], 0.1, (0.0, 0.0, 0.0)).save(tmp_path / "hall.yaml")
    scan = table("scan", robot="rrbot", frame="base", simulate="hall.yaml", after="rrbot")
    child = up(robot() + table("map", file="hall.yaml") + scan)
    lines_until(child, "hall: 2 x 1 cells", "rrbot: scans in base, 30 Hz")
    interrupted(child)


@pytest.mark.processes
def test_a_driver_and_a_recorder_of_a_robot_run_in_the_folder_of_the_file(up, tmp_path: Path):
    drive = table("drive", driver="sim", robot="rrbot", names="left right")
    record = table("record", file="run.mcap", robots=["left", "right"], after=["left/drive", "right/drive"])
    child = up(drive + record)
    lines = lines_until(child, "driving 'left'", "driving 'right'")
    assert {line.split()[0] for line in lines} == {"left/drive", "right/drive"}
    until((tmp_path / "run.mcap").exists)
    interrupted(child)


@pytest.mark.processes
def test_json_lines_name_their_process(up):
    child = up(robot(source="joints"), "--log-format", "json")
    child.line()
    until(lambda: '"part": "rrbot"' in child.stderr or child.process.poll() is not None)
    interrupted(child)


def test_the_file_in_its_help_is_one_that_it_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("ROBOTS", raising=False)
    monkeypatch.setenv("SITE", "hall")
    help_text = up_command.help or ""
    (tmp_path / "network.toml").write_text("[network]\nmode = 'peer'\n")
    (tmp_path / "handeye.yaml").write_text("{target: panda_link0, source: eye, xyz: [0, 0, 1]}")
    (tmp_path / "hall.yaml").touch()
    (tmp_path / "fleet").mkdir()
    lines = [line.strip() for line in help_text[help_text.index("include =") :].splitlines()]
    text = "\n".join(lines).replace('model = "panda"', f'model = "{RRBOT}"')
    shown = run_cli("up", str(file_of(tmp_path, text)), "--check", "rate=20")
    assert [line.split()[0] for line in shown.stdout.splitlines()] == (
        [
            "router",
            "left",
            "right",
            "arm1",
            "arm2",
            "arm3",
            "static",
            "hall/map",
            "left/scan",
            "panda/drive",
            "driver",
        ]
    ), shown.stderr
    assert max(map(len, lines)) <= 78, "it wraps on a terminal of 80 columns"


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("", "starts nothing"),
        ("[[robot]\n", "line 1"),
        (
            "\n[router]\nlisen = []\n",
            "cell.toml:3: router.lisen: there is no such key; did you mean 'listen'?",
        ),
        ("[network]\nconnect = ['10.0.0.1']\n", "cell.toml:1: network: '10.0.0.1' is not an endpoint"),
        ("[network]\nmode = 'client'\n", "network: mode 'client' needs connect"),
        ("[robot]\nmodel = 'panda'\n", "cell.toml:1: robot: write [[robot]]"),
        ("[[robott]]\nmodel = 'panda'\n", "robott: there is no such table; did you mean 'robot'?"),
        ("[[robots]]\nmodel = 'panda'\n", "cell.toml:1: robots: `zstate robots` cannot be a table"),
        (robot(model="rrbott"), "robot[0]: no robot is called 'rrbott'; did you mean 'rrbot'"),
        (robot(rate=0), "robot[0].rate: a rate is above 0"),
        (robot() + robot(rate="fast"), "cell.toml:7: robot[1].rate: 'fast' is not a valid float"),
        (robot() + robot(), "robot[1]: robot[0] is called 'rrbot' already"),
        (robot(name="a b"), "robot[0]: the robot name 'a b' contains ' '"),
        (robot(source="file"), "cell.toml:3: robot[0].source: 'file' is neither 'joints' nor"),
        (robot(names=["a"], name="b"), "robot[0]: a loop is names = ['left', 'right'], or count"),
        (robot(count=2), "robot[0]: a loop is names"),
        (robot(count="few", name="a${number}"), "cell.toml:4: robot[0].count: 'few' is not a count"),
        (robot(when="maybe"), "robot[0].when: 'maybe' is neither true nor false"),
        (
            robot(rate="${sped}") + "[parameters]\nspeed = 1\n",
            "robot[0].rate: ${sped} is neither a parameter",
        ),
        (robot(after="x"), "robot[0].after: no process is called 'x'; there are rrbot"),
        (
            robot(name="a", after="b") + robot(name="b", after="a"),
            "robot[0].after: 'a' waits for itself",
        ),
        (robot(identity="a"), "robot[0].identity: needs certs"),
        (
            "[network]\ncerts = '.'\n" + robot(),
            "robot[0]: the certs of [network] need an identity",
        ),
        ("[[up]]\nfile = 'a'\n", "cell.toml:1: up: `zstate up` cannot be a table: include ="),
        ("[[snapshot]]\n", "snapshot[0]: `zstate snapshot` is several commands; write [[program]]"),
        (table("drive", driver="sim"), "drive[0]: there is no robot, which `zstate drive` needs"),
        (
            table("drive", driver="arm.py:Arm", robot="rrbot"),
            "cell.toml:2: drive[0].driver: there is no file 'arm.py'",
        ),
        (table("drive", drivr="sim"), "drive[0].drivr: there is no such key; did you mean 'driver'?"),
        (table("hz", colour=1), "hz[0].colour: there is no such key; there are robot, stream"),
        (table("map", wire="ros2", wires=["ros2"]), "map[0].wires: is there as wire already"),
        (table("map", takeover=True), "map[0].takeover: there is no such key"),
        (table("plot", path=["a"]), "plot[0].path: takes 2 values, not ['a']"),
        (table("publish", robot="--help"), "publish[0].robot: '--help' would be an option"),
        (robot(takeover="perhaps"), "robot[0].takeover: 'perhaps' is not a valid boolean"),
        ("[network]\nrestart = 'always'\n", "network.restart: there is no such key"),
        ("include = 'cell.toml'\n", "cell.toml:1: include: 'cell.toml' includes this file again"),
        ("include = 'gone.toml'\n", "include: there is no file"),
        (table("program", run=""), "program[0].run: is empty"),
        (table("map", file="gone.yaml"), "map[0].file: File"),
        (table("scan", robot="r1", frame="f"), "scan[0]: give --simulate MAP.yaml or --dummy"),
        (table("scan", robot="r1", frame="f", simulate="gone.yaml"), "scan[0].simulate: File"),
        (
            '[parameters]\nwho = "O\'Neill"\n' + table("program", run="echo ${who}"),
            'program[0].run: "echo O\'Neill" is not a command line (No closing quotation)',
        ),
        (
            table("program", run="./gone"),
            "'gone' ended with exit code 1: './gone' cannot be started: No such file",
        ),
        (STATIC, "static[0]: the robot of this edge is unknown"),
        (
            robot() + STATIC.replace("rpy_deg", "rpy_rad"),
            "static[0].rpy_rad: there is no such key; did you mean",
        ),
        (robot() + STATIC.replace("[0, 0, 1]", "[0, 0]"), "static[0].xyz"),
        (robot() + STATIC.replace("flange", "lower"), "itself"),
        (robot() + STATIC.partition("xyz")[0], "'flange' in 'lower' has 0 rotations and no xyz"),
        (
            robot() + STATIC + "robot = 'x*'\n",
            "static[0].robot: no robot matches 'x*'; in this file: 'rrbot'",
        ),
        (robot() + table("static", file="gone.yaml"), "static[0].file: "),
        (
            robot() + STATIC + "file = 'a.yaml'\n",
            "static[0]: the pose is in 'a.yaml'; leave out xyz, rpy_deg",
        ),
    ],
)
def test_invalid_file_error_names_the_place(tmp_path: Path, text: str, error: str):
    message = failure("up", str(file_of(tmp_path, text)))
    assert error in message


@pytest.mark.parametrize(
    ("setting", "error"),
    [
        ("sped=2", "has no parameter 'sped'; did you mean 'speed'?; its [parameters]: speed"),
        (
            "speed=fast",
            "cell.toml:2: parameters.speed: it is 1.0 in the file, and 'fast' is not of that type",
        ),
        ("speed:=2", "'speed:=2' is written as for ROS; here it is speed=2"),
        ("speed", "'speed' is not a parameter; write KEY=VALUE"),
    ],
)
def test_a_parameter_that_the_file_does_not_have_is_refused(tmp_path: Path, setting: str, error: str):
    file = file_of(tmp_path, "[parameters]\nspeed = 1.0\n" + robot())
    assert error in failure("up", str(file), setting)
