"""The file of a robot's stops: its lock, what is damaged, and what a loss of power leaves."""

from __future__ import annotations

import json
import multiprocessing
import os
import re
from pathlib import Path

import pytest
from helpers.processes import DEADLINE_S

from zstate.driving.stops_file import ActiveStop, HostLock, read_stops, stops_file, write_stops
from zstate.errors import ConfigError, SecondWriter
from zstate.net.presence import local_writer

STOP = ActiveStop(7, 3, "relax", "door open", "desk@station pid 12")

HOST = """
    from zstate.driving.stops_file import HostLock
    with HostLock("arm"):
        print("open", flush=True)
        input()
"""


def test_one_host_of_a_robot_has_the_lock_and_the_other_is_refused_with_its_process(spawn):
    first = spawn(HOST)
    first.line()
    with pytest.raises(SecondWriter, match=rf"pid {first.process.pid}' already hosts a driver of 'arm'"):
        HostLock("arm")
    with HostLock("base"):
        first.kill()
    with (
        HostLock("arm"),
        pytest.raises(SecondWriter, match=f"^{re.escape(repr(str(local_writer(0))))} already"),
    ):
        HostLock("arm")
    HostLock("arm").close()


def test_a_forked_child_does_not_keep_the_lock():
    lock = HostLock("arm")
    fork = multiprocessing.get_context("fork")
    has_tried, may_end = fork.Event(), fork.Event()

    def child() -> None:
        lock.close()
        with pytest.raises(SecondWriter):
            HostLock("arm")
        has_tried.set()
        may_end.wait(DEADLINE_S)

    process = fork.Process(target=child)
    process.start()
    try:
        assert has_tried.wait(DEADLINE_S)
        lock._file.close()  # as a killed parent does, without the unlocking of close()
        with HostLock("arm"):
            may_end.set()
    finally:
        process.join(DEADLINE_S)
    assert process.exitcode == 0


def test_without_a_home_folder_the_variable_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_STATE_HOME", "~no-such-user/state")
    with pytest.raises(ConfigError, match=r"home directory.*set XDG_STATE_HOME"):
        stops_file("arm")


def test_the_folder_is_on_the_disk_after_the_file(tmp_path, monkeypatch: pytest.MonkeyPatch):
    synced: list[Path] = []
    fsync = os.fsync

    def keep(number: int) -> None:
        synced.append(Path(f"/proc/self/fd/{number}").readlink())
        fsync(number)

    monkeypatch.setattr(os, "fsync", keep)
    write_stops(tmp_path / "arm.json", [STOP], {5: [0, 9]})
    assert synced[-1] == tmp_path
    assert synced[0].parent == tmp_path
    assert read_stops(tmp_path / "arm.json") == ([STOP], {5: [0, 9]})


FIELDS = {"session": 7, "seq": 3, "how": "hold", "reason": "", "who": "desk"}


@pytest.mark.parametrize(
    "document",
    [
        {"stops": [FIELDS | {"session": "7"}], "released": []},
        {"stops": [FIELDS | {"seq": 0.5}], "released": []},
        {"stops": [FIELDS | {"seq": -1}], "released": []},
        {"stops": [FIELDS | {"session": True}], "released": []},
        {"stops": [FIELDS | {"how": "fall"}], "released": []},
        {"stops": [FIELDS | {"how": ["hold"]}], "released": []},
        {"stops": [FIELDS | {"reason": None}], "released": []},
        {"stops": [FIELDS | {"who": {}}], "released": []},
        {"stops": [FIELDS | {"more": 1}], "released": []},
        {"stops": [], "released": [[7, "3"]]},
        {"stops": [], "released": [[7]]},
        {"stops": []},
        [],
    ],
)
def test_fields_of_wrong_types_are_damage(tmp_path, document: object):
    path = tmp_path / "arm.json"
    path.write_text(json.dumps(document))
    with pytest.raises(ValueError):
        read_stops(path)
