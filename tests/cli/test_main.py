from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from pathlib import Path

import pytest
from helpers.cli_runner import RRBOT, Spawn, failure, interrupted, run_cli, run_process, started
from helpers.processes import ZENOH_CLOSE_S

from zstate import connect, load_model
from zstate.cli import main
from zstate.cli.commands import own_commands
from zstate.cli.processes import orderly_exit
from zstate.cli.signals import CHECKED_AFTER_S, SignalExit
from zstate.model.pinocchio_solver import load_pinocchio
from zstate.plugins import built_in_plugins
from zstate.sources import JointStateListener


def await_samples() -> None:
    """Until two samples of the RRBot have come in."""
    with connect() as session, JointStateListener(session, "rrbot", load_model(RRBOT)) as source:
        readings = iter(source)
        assert next(readings).stamp != next(readings).stamp


def test_unquoted_path_with_a_space_is_recognised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "my arm").mkdir()
    (tmp_path / "my arm" / "arm.urdf").write_text(Path(RRBOT).read_text())
    monkeypatch.chdir(tmp_path)
    for arguments in (("check",), ("publish", "--source", "sine"), ("up",)):
        message = failure(*arguments, "my", "arm/arm.urdf", code=2)
        assert "one path with a space in it; write it in quotes: 'my arm/arm.urdf'" in message


def test_without_a_command_the_help_is_printed():
    alone, helped = run_cli(), run_cli("--help")
    assert (alone.code, alone.stdout, alone.stderr) == (0, helped.stdout, "")
    assert run_cli("snapshot").stdout.startswith("Usage: zstate snapshot")


def test_mistyped_command_gets_the_nearest_one():
    message = failure("jonts", code=2)
    assert "there is no command 'jonts'; did you mean 'joints'?" in message


@pytest.mark.parametrize(
    ("word", "hint"),
    [
        ("tf2_echo", "use `zstate tf`"),
        ("rviz2", "use `zstate view`"),
        ("list", "use `zstate ls`"),
        ("bag", "use `zstate record` or `zstate replay` or `zstate info`"),
        ("rqt", "use `zstate graph` or `zstate plot` or `zstate view`"),
        ("launch", "use `zstate up FILE.toml`"),
        ("static-transform-publisher", "use `zstate static`"),
        ("quxquux", "`zstate help` lists the commands"),
    ],
)
def test_commands_of_ros_lead_to_their_equivalents(word: str, hint: str):
    assert f"there is no command {word!r}; {hint}" in failure(word, code=2)


def test_every_synonym_leads_to_commands_that_exist():
    for owner, table in (("", main._SYNONYMS), *((one.name, one.synonyms) for one in built_in_plugins())):
        for commands in table.values():
            for command in commands.split(" | "):
                assert own_commands()[command.split()[0]].reference.startswith(f"zstate.{owner or 'cli'}."), (
                    command
                )
        assert not set(table) & set(own_commands())


def test_help_is_a_command_too():
    assert run_cli("help").stdout == run_cli("--help").stdout
    assert run_cli("help", "tf").stdout == run_cli("tf", "--help").stdout
    assert "there is no command 'nothing'" in failure("help", "nothing", code=2)


@pytest.mark.parametrize(
    ("given", "written"),
    [
        ("0.1 0 0.2 3 -2 1 wrist camera", "wrist camera --xyz 0.1 0 0.2 --rpy 1 -2 3"),
        ("1 2 3 0 0 0 1 wrist camera", "wrist camera --xyz 1 2 3 --quat-xyzw 0 0 0 1"),
        (
            "--x 1 --yaw=1.5 --frame-id wrist --child-frame-id camera",
            "wrist camera --xyz 1 0 0 --rpy 0 0 1.5",
        ),
        ("--qx 1 --qw -0 --child-frame-id camera", "TARGET camera --quat-xyzw 1 0 0 -0"),
    ],
)
def test_the_forms_of_static_transform_publisher_are_translated(given: str, written: str):
    for command in ("static", "static_transform_publisher"):
        message = failure(command, *given.split(), code=2)
        assert f"static_transform_publisher; here it is\n  zstate static {written}\n" in message


def test_unknown_option_gets_a_suggestion_only_if_one_is_similar():
    assert "Did you mean '--connect'?" in failure("ls", "--conect", code=2)
    message = failure("ls", "--nonsense", code=2)
    assert "--nonsense" in message
    assert "Did you mean" not in message


def test_wrong_usage_exits_with_code_2_and_a_message():
    assert "--rate" in failure("joints", RRBOT, "--rate", "0", code=2)
    assert "nan" in failure("joints", RRBOT, "--rate", "nan", code=2)
    assert "-1" in failure("publish", RRBOT, "--rate", "-1", code=2)
    assert "-2" in failure("joints", RRBOT, "--seconds", "-2", code=2)
    assert "--connect" in failure("joints", RRBOT, "--mode", "client", code=2)


def test_unknown_robot_is_reported_with_near_misses():
    message = failure("joints", "rrbott")
    assert message.startswith("zstate: ")
    assert "did you mean 'rrbot'" in message


def test_invalid_endpoint_is_reported_with_the_right_form():
    assert "tcp/10.0.0.1:7447" in failure("joints", RRBOT, "--connect", "10.0.0.1")


def test_invalid_robot_name_is_reported_with_the_name_option():
    message = failure("joints", RRBOT, "--name", "left/arm")
    assert "'/'" in message
    assert "--name" in message


def test_unreachable_router_is_reported(tmp_path: Path, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    impatient = tmp_path / "impatient.json5"
    impatient.write_text("{connect: {timeout_ms: 200, exit_on_failure: true}}")
    given = ("--config", str(impatient), "--mode", "client", "--connect", endpoint)
    message = failure("joints", RRBOT, *given)
    assert f"nothing answers at {endpoint!r} (connection refused" in message
    assert f"`zstate doctor --connect {endpoint}`" in message


@pytest.mark.processes
def test_ctrl_c_interrupts_connecting_to_a_router(spawn: Spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    child = spawn(
        "import zstate.net.session as s\n"
        "connect = s.connect\n"
        "def logged_connect(*given, **named):\n"
        "    print('connecting', flush=True)\n"
        "    return connect(*given, **named)\n"
        "s.connect = logged_connect\n"
        "from zstate.cli.main import main; main()",
        *("joints", RRBOT, "--mode", "client", "--connect", endpoint),
    )
    assert child.line() == "connecting"
    interrupted(child)


@pytest.mark.processes
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_sigterm_ends_in_order(spawn: Spawn, number: signal.Signals):
    child = started(spawn, "joints", RRBOT)
    child.line()
    await_samples()
    began = time.monotonic()
    child.process.send_signal(number)
    assert child.wait() == 128 + number
    assert time.monotonic() - began < ZENOH_CLOSE_S
    assert " samples; commanded 100 Hz" in child.line()
    assert "Traceback" not in child.stderr


def test_the_session_options_are_read_from_the_environment(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ZSTATE_MODE", "client")
    assert "--mode client needs --connect" in failure("joints", RRBOT, code=2)
    monkeypatch.setenv("ZSTATE_CONNECT", "tcp/here")
    assert "'tcp/here'" in failure("joints", RRBOT)


@pytest.mark.processes
def test_closed_output_ends_a_command_quietly():
    command = [sys.executable, "-m", "zstate", "check", RRBOT]
    read_end, write_end = os.pipe()
    os.close(read_end)
    ended = subprocess.run(command, stdout=write_end, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write_end)
    assert ended.stderr == ""


def test_version_names_the_kernel_and_the_engine_of_publishers():
    from zstate import __version__, kernel

    engine = f"Pinocchio {load_pinocchio().__version__}"
    expected = f"zstate {__version__} (kernel: {kernel}, transforms of publishers: {engine})\n"
    assert run_cli("--version").stdout == expected


@pytest.mark.processes
def test_version_and_doctor_name_the_closed_forms_where_pinocchio_cannot_be_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "pinocchio.py").write_text(
        "raise ImportError('libgomp.so.1: cannot open shared object file')"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    assert run_process("--version").stdout.endswith("transforms of publishers: closed forms)\n")
    check = run_process("doctor").stdout
    assert "closed forms" in check
    assert "libgomp.so.1" in check
    assert "apt-get install libgomp1" in check


@pytest.mark.processes
def test_ctrl_c_during_publishing_prints_the_achieved_rate(spawn: Spawn):
    child = started(spawn, "joints", RRBOT, "--rate", "50")
    assert child.line() == "rrbot: a sine on 2 joints, 50 Hz, on zstate/rrbot/joint_states"
    await_samples()
    interrupted(child)
    assert "commanded 50 Hz, achieved " in child.line()


def lose_ctrl_c() -> None:
    """Ctrl-C in a function that Python calls, and whose exceptions it ignores, as Zenoh does."""

    class Watched:
        pass

    watched = Watched()
    end = weakref.ref(watched, lambda _: signal.raise_signal(signal.SIGINT))
    del watched
    assert end() is None


def work_until_interrupted(events: list[str]) -> None:
    """Lose a Ctrl-C, go on until it is raised again, and clean up for longer than until the next check."""
    try:
        lose_ctrl_c()
        events.append("lost")
        while True:
            threading.Event().wait(0.05)
    finally:
        deadline = time.monotonic() + 2 * CHECKED_AFTER_S
        while time.monotonic() < deadline:
            threading.Event().wait(0.05)
        events.append("cleaned up")


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_ctrl_c_that_is_lost_is_raised_again_but_not_while_the_command_cleans_up(
    monkeypatch: pytest.MonkeyPatch,
):
    events: list[str] = []
    monkeypatch.setattr(main.group, "main", lambda *_, **__: work_until_interrupted(events))
    before = signal.signal(signal.SIGINT, main._end)
    try:
        assert main.run([]) == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert events == ["lost", "cleaned up"]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_lost_ctrl_c_ends_a_block_with_an_orderly_exit_as_well():
    """That of `zstate drive`, whose driver is stopped in it."""
    events: list[str] = []
    with pytest.raises(SignalExit), orderly_exit() as begin_end:
        try:
            work_until_interrupted(events)
        finally:
            begin_end()
    assert events == ["lost", "cleaned up"]
