from __future__ import annotations

import json
import os
import socket

import pytest
from looking import EVERYTHING, failure, standing, zstate

from zstate import StaticPublisher, connect

pytestmark = pytest.mark.processes


def test_each_stream_stands_with_its_writer():
    with standing():
        robot, *streams = zstate("ls").stdout.decode().splitlines()
    assert robot == "rrbot"
    assert sorted(line.split()[0] for line in streams) == sorted(EVERYTHING)
    for line in streams:
        assert f"@{socket.gethostname()} pid {os.getpid()}" in line
        assert "since 20" in line


def test_json_names_robots_and_writers():
    with standing("left", streams=("joint_states",)), standing("right"):
        robots = json.loads(zstate("ls", "--json").stdout)
    assert [robot["robot"] for robot in robots] == ["left", "right"]
    (writer,) = robots[0]["writers"]
    assert (writer["stream"], writer["pid"]) == ("joint_states", os.getpid())


def test_static_edges_stand_with_the_name_under_which_they_are_written():
    with connect() as session, StaticPublisher(session, "arm", "mount"):
        lines = zstate("ls").stdout.decode().splitlines()
        (robot,) = json.loads(zstate("ls", "--json").stdout)
    assert lines[0] == "arm"
    assert lines[1].split()[0] == "tf_static/mount"
    assert [writer["names"] for writer in robot["writers"]] == [["mount"]]


def test_nobody_is_no_error():
    ended = zstate("ls")
    assert (ended.returncode, ended.stdout) == (0, b"")
    assert b"no robot is announced" in ended.stderr
    assert json.loads(zstate("ls", "--json").stdout) == []


def test_an_endpoint_that_cannot_be_is_named():
    assert "nonsense" in failure("ls", "--connect", "nonsense")
