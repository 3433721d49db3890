"""One run of one subject in one scenario, in fresh processes."""

from __future__ import annotations

import os
import socket
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypeAlias

from bench.job import Job
from bench.measure import Costs
from bench.poses import pose_errors
from bench.process import ROOT, Process, RunFailed, free_ports
from bench.recording import Recording, Window, rate_in, reader_figures
from bench.robot import BenchRobot, bench_robot
from bench.scenario import Scenario
from bench.subjects.subject import Service, Subject

PORTS = 6
START_WITHIN_S = 60.0
WARM_UP_S = 0.7
# Writers continue after the window, so that its last samples are handled like all others.
AFTER_S = 0.3
DRAIN_S = 0.5
PROBE_EVERY_S = 0.2

Facts: TypeAlias = "dict[str, Any]"


def run_trial(subject: Subject, scenario: Scenario) -> Facts:
    """The figures of the run, or ``failed`` with the reason."""
    with tempfile.TemporaryDirectory(prefix="zstate-bench-") as folder, ExitStack() as opened:
        try:
            trial = Trial(subject, scenario, folder, opened)
            return trial.joins() if scenario.joins else trial.run()
        except (RunFailed, OSError) as reason:  # OSError: a process had ended when its cost was read
            return {"failed": str(reason)}


class Trial:
    """The processes of one run; ``opened`` stops them, the last one first."""

    def __init__(self, subject: Subject, scenario: Scenario, folder: str, opened: ExitStack) -> None:
        self._subject = subject
        self._scenario = scenario
        self._robot = bench_robot(scenario.robot)
        self._opened = opened
        self._job = build_job(subject, scenario, self._robot, folder)
        self._environment = subject.environment(self._job)
        self._roles: dict[str, list[int]] = {}
        for service in subject.services(self._job):
            self._start_service(service)

    def run(self) -> Facts:
        """Figures of the readers and costs of all processes over one window."""
        readers = [self._start_worker("reader", f"reader{n}") for n in range(self._scenario.readers)]
        shares = self._shares()
        writers = [self._start_worker("writer", label, mine) for label, mine in shares.items()]
        self._start_roles(writers, readers)
        time.sleep(WARM_UP_S)
        window, costs = self._measure_window()
        ends = {"begin": window.begin, "end": window.end}
        time.sleep(AFTER_S)
        for writer in writers:
            writer.send_command(do="stop")
        for writer in writers:
            writer.wait_for_event("result", START_WITHIN_S)
        time.sleep(DRAIN_S)
        for reader in readers:
            reader.send_command(do="stop", **ends)
        poses = [pose for one in readers for pose in one.wait_for_event("result", START_WITHIN_S)["poses"]]
        folder = self._job.folder
        everything = Recording.read_writers(folder, shares)
        sent = everything.of_robots(self._scenario.followed)
        answered = [Recording.read_reader(folder, f"reader{n}") for n in range(len(readers))]
        return {
            "window_s": round(window.seconds, 4),
            "sent": int(window.holds(sent.stamps).sum()),
            "sent_hz": round(rate_in(everything.stamps, window), 3),
            "readers": [reader_figures(sent, one, window, self._scenario.rate_hz) for one in answered],
            **costs.figures(),
            "poses": pose_errors(sent, self._robot.poses, poses, window.begin),
        }

    def joins(self) -> Facts:
        """Times of late joiners, one after the other, while a writer and a reader continue."""
        reader = self._start_worker("reader", "reader0")
        writer = self._start_worker("writer", "writer0", [0])
        self._start_roles([writer], [reader])
        time.sleep(WARM_UP_S)
        joined: list[Facts] = []
        for number in range(self._scenario.joins):
            with ExitStack() as opened:
                joiner = self._start_worker("joiner", f"joiner{number}", opened=opened)
                joiner.wait_for_event("ready", START_WITHIN_S)
                joiner.send_command(do="go")
                joined.append(joiner.wait_for_event("result", START_WITHIN_S))
        seconds = [one["whole_s"] for one in joined]
        if None in seconds:
            return {
                "failed": f"{seconds.count(None)} of {len(seconds)} late joiners never had the whole tree"
            }
        return {
            "whole_ms": [round(1e3 * one, 1) for one in seconds],
            "connected_ms": [round(1e3 * one["connected_s"], 1) for one in joined],
        }

    def _start_service(self, service: Service) -> None:
        environment = {**self._environment, **service.environment}
        process = Process(service.role, service.command, environment, is_service=True)
        self._opened.callback(process.stop)
        self._roles.setdefault(service.role, []).append(process.pid)
        deadline = time.monotonic() + service.within_s
        if service.ready_text:
            process.wait_for_text(service.ready_text, service.within_s)
        while not _is_ready(service, environment):
            if time.monotonic() > deadline:
                raise process.failed(f"was not ready within {service.within_s:g} s")
            time.sleep(PROBE_EVERY_S)

    def _start_worker(
        self, role: str, label: str, mine: Sequence[int] = (0,), opened: ExitStack | None = None
    ) -> Process:
        python = self._subject.python()
        assert python is not None, f"{self._subject.name} is not installed"
        command = [python, "-m", "bench.worker", self._subject.name, role, label]
        process = Process(label, command, self._environment)
        (opened or self._opened).callback(process.stop)
        if opened is None:
            self._roles.setdefault(role, []).append(process.pid)
        process.send_line(self._job.for_robots(*(self._job.robots[n] for n in mine)).to_json())
        return process

    def _shares(self) -> dict[str, Sequence[int]]:
        """The robot indices of each writer process."""
        count = self._scenario.writers
        return {f"writer{n}": range(len(self._job.robots))[n::count] for n in range(count)}

    def _start_roles(self, writers: Sequence[Process], readers: Sequence[Process]) -> None:
        """Waits until all are connected, starts the writers, waits for the first answers of every reader."""
        for process in (*readers, *writers):
            process.wait_for_event("ready", START_WITHIN_S)
        for writer in writers:
            writer.send_command(do="go")
        for reader in readers:
            reader.wait_for_event("first", START_WITHIN_S)

    def _measure_window(self) -> tuple[Window, Costs]:
        costs = Costs(self._roles)
        begin = time.time_ns()
        costs.start()
        time.sleep(self._scenario.seconds)
        costs.stop()
        return Window(begin, time.time_ns()), costs


def build_job(subject: Subject, scenario: Scenario, robot: BenchRobot, folder: str) -> Job:
    """The job sent to every process of the run."""
    urdf = Path(folder) / "robot.urdf"
    urdf.write_text(robot.model.urdf, encoding="utf-8")
    robots = ("robot",) if scenario.fleet == 1 else tuple(f"robot{n:03}" for n in range(scenario.fleet))
    return Job(
        subject=subject.name,
        urdf=str(urdf),
        joints=robot.model.joint_names,
        base=robot.model.root,
        tip=robot.tip,
        links=robot.model.links,
        rows=tuple(map(tuple, robot.rows.tolist())),
        rate_hz=scenario.rate_hz,
        robots=robots,
        mine=robots[:1],
        readers=scenario.readers,
        follows=scenario.follows,
        routers=scenario.routers,
        one_link=scenario.one_link,
        load=scenario.load,
        ports=free_ports(PORTS),
        folder=folder,
    )


def _is_ready(service: Service, environment: Mapping[str, str]) -> bool:
    if service.port:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", service.port)) != 0:
                return False
    if service.probe:
        done = subprocess.run(
            service.probe, cwd=ROOT, env={**os.environ, **environment}, capture_output=True, check=False
        )
        return done.returncode == 0
    return True
