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
from bench.measure import Costs, growth, usage
from bench.process import ROOT, START_WITHIN_S, Process, RunFailed, free_ports
from bench.recording import Recording, Window, pose_errors, rate_in, reader_figures
from bench.robot import BenchRobot, bench_robot, write_motion
from bench.scenario import Scenario
from bench.subjects.subject import Service, Subject

PORTS = 6
WARM_UP_S = 0.7
# Writers continue after the window, so that its last samples are handled like all others.
AFTER_S = 0.3
DRAIN_S = 0.5
PROBE_EVERY_S = 0.2
# In a soak.
SAMPLES, SAMPLE_S, JOIN_EVERY_S = 20, 5.0, 60.0

Facts: TypeAlias = "dict[str, Any]"


def run_trial(subject: Subject, scenario: Scenario) -> Facts:
    """The figures of the run, or ``failed`` with the reason."""
    with tempfile.TemporaryDirectory(prefix="zstate-bench-") as folder, ExitStack() as opened:
        try:
            trial = Trial(subject, scenario, folder, opened)
            return trial.soak() if scenario.soaks else trial.run()
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
        self._processes: dict[str, list[Process]] = {}
        for service in subject.services(self._job):
            self._start_service(service)
        self._readers = [self._start_worker("reader", f"reader{n}") for n in range(scenario.readers)]
        # The robot indices of each writer process.
        count = scenario.writers
        self._shares = {f"writer{n}": range(len(self._job.robots))[n::count] for n in range(count)}
        self._writers = [self._start_worker("writer", *share) for share in self._shares.items()]
        for process in (*self._readers, *self._writers):
            process.wait_for_event("ready", START_WITHIN_S)
        for writer in self._writers:
            writer.send_command(do="go")
        for reader in self._readers:
            reader.wait_for_event("first", START_WITHIN_S)
        time.sleep(WARM_UP_S)

    def run(self) -> Facts:
        """Figures of the readers and costs of all processes over one window."""
        costs = Costs({role: [one.pid for one in some] for role, some in self._processes.items()})
        begin = time.time_ns()
        costs.start()
        time.sleep(self._scenario.seconds)
        costs.stop()
        window = Window(begin, time.time_ns())
        time.sleep(AFTER_S)
        joins_ms = [self._join() for _ in range(self._scenario.joins)]
        self._stop(self._writers)
        time.sleep(DRAIN_S)
        results = self._stop(self._readers, begin=window.begin, end=window.end)
        folder = self._job.folder
        everything = Recording.read_writers(folder, self._shares)
        sent = everything.of_robots(self._scenario.followed)
        answered = [Recording.read_reader(folder, f"reader{n}") for n in range(len(self._readers))]
        answers = [pose for one in results for pose in one["poses"]]
        return {
            "window_s": round(window.seconds, 4),
            "sent": int(window.holds(sent.stamps).sum()),
            "sent_hz": round(rate_in(everything.stamps, window), 3),
            "readers": [reader_figures(sent, one, window, self._scenario.rate_hz) for one in answered],
            **costs.figures(),
            "joins_ms": joins_ms,
            "poses": pose_errors(sent, self._robot.poses, answers, window.begin),
        }

    def soak(self) -> Facts:
        """Growth and CPU of every process, lost samples and latched values, and a late joiner each minute."""
        named = {
            f"{role} {n}" if len(some) > 1 else role: one.pid
            for role, some in self._processes.items()
            for n, one in enumerate(some)
        }
        costs = Costs({name: [pid] for name, pid in named.items()})
        samples: dict[str, list[tuple[float, int, int, int]]] = {name: [] for name in named}
        seconds, joins_ms = self._scenario.seconds, []
        begin = next_sample = time.monotonic()
        costs.start()
        next_join = begin + min(JOIN_EVERY_S, seconds) / 2
        while (now := time.monotonic()) < begin + seconds:
            for name, pid in named.items():
                samples[name].append(usage(pid))
            if now >= next_join:
                next_join += JOIN_EVERY_S
                joins_ms.append(self._join())
            next_sample += min(SAMPLE_S, seconds / SAMPLES)
            time.sleep(max(0.0, next_sample - time.monotonic()))
        costs.stop()
        sent = sum(one["count"] for one in self._stop(self._writers))
        time.sleep(DRAIN_S)
        [reader] = self._stop(self._readers)
        cpu = costs.figures()["cpu_percent"]
        grown = {name: {"cpu_percent": cpu[name], **growth(some)} for name, some in samples.items()}
        return {"soak": {"sent": sent, "joins_ms": joins_ms, **reader, "processes": grown}}

    def _join(self) -> float:
        """The time [ms] until a late joiner has the whole tree. Raises RunFailed if it never has."""
        with ExitStack() as opened:
            joiner = self._start_worker("joiner", "joiner", opened=opened)
            joiner.wait_for_event("ready", START_WITHIN_S)
            joiner.send_command(do="go")
            whole_s = joiner.wait_for_event("result", START_WITHIN_S)["whole_s"]
            if whole_s is None:
                raise joiner.failed("never had the whole tree")
            return round(1e3 * whole_s, 1)

    def _stop(self, workers: Sequence[Process], **command: object) -> list[Facts]:
        """Stops all, and returns their results."""
        for worker in workers:
            worker.send_command(do="stop", **command)
        results = [worker.wait_for_event("result", START_WITHIN_S) for worker in workers]
        return [{name: value for name, value in one.items() if name != "event"} for one in results]

    def _start_service(self, service: Service) -> None:
        process = Process(service.role, service.command, self._environment, is_service=True)
        self._opened.callback(process.stop)
        self._processes.setdefault(service.role, []).append(process)
        deadline = time.monotonic() + service.within_s
        if service.ready_text:
            process.wait_for_text(service.ready_text, service.within_s)
        while not _is_ready(service, self._environment):
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
            self._processes.setdefault(role, []).append(process)
        process.send_line(self._job.for_robots(*(self._job.robots[n] for n in mine)).to_json())
        return process


def build_job(subject: Subject, scenario: Scenario, robot: BenchRobot, folder: str) -> Job:
    """The job sent to every process of the run."""
    motion = Path(folder) / "robot"
    write_motion(motion, robot.model, robot.rows)
    robots = ("robot",) if scenario.fleet == 1 else tuple(f"robot{n:03}" for n in range(scenario.fleet))
    return Job(
        subject=subject.name,
        urdf=str(motion.with_suffix(".urdf")),
        motion=str(motion),
        joints=robot.model.joint_names,
        base=robot.model.root,
        tip=robot.tip,
        links=robot.model.links,
        rows=tuple(map(tuple, robot.rows.tolist())),
        rate_hz=scenario.rate_hz,
        robots=robots,
        mine=robots[:1],
        follows=scenario.follows,
        routers=scenario.routers,
        one_link=scenario.one_link,
        soaks=scenario.soaks,
        ports=free_ports(PORTS),
        folder=folder,
    )


def _is_ready(service: Service, environment: Mapping[str, str]) -> bool:
    if service.port:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", service.port)) != 0:
                return False
    if service.probe:
        variables = {**os.environ, **environment}
        done = subprocess.run(service.probe, cwd=ROOT, env=variables, capture_output=True, check=False)
        return done.returncode == 0
    return True
