"""What pictures and clouds cost the joint states that share a router with them.

Three cameras of 1280x720 at 30 Hz and a lidar of 130,000 points at 10 Hz, each with a process of its own as
their drivers have, one reader of all of them, and a robot at 1000 Hz with a reader of its own, through one
router. The same is measured without pictures and clouds, and with everything on one priority. Latency is from
the stamp of a joint state to its arrival in the reader.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from bench.micro.form import Row, end_of_input, result_of, running_role, send_event
from bench.process import free_ports, running_command
from zstate import SineSource, StatePublisher, StreamListener, connect, load_model
from zstate.cameras import CameraPublisher
from zstate.clouds import CloudPublisher, SimulatedLidar
from zstate.net.streams import KeyPublisher
from zstate.nodes.stream_listener import ReceivedMessage

CAMERAS, CAMERA_HZ, LIDAR_HZ, STATE_HZ = 3, 30.0, 10.0, 1000.0
LIDAR = "lidar"


def measure(robot: str = "talos", rounds: int = 3, seconds: float = 8.0) -> Iterator[Row]:
    """Rows of each case, interleaved over the rounds."""
    cases = {"alone": None, "with pictures and clouds": False, "the same on one priority": True}
    p50, p99, lost, arrived = ({case: [] for case in cases} for _ in range(4))
    for _ in range(rounds):
        for case, on_one_priority in cases.items():
            result = measured_case(robot, seconds, on_one_priority)
            for values, value in zip((p50, p99, lost, arrived), result, strict=True):
                values[case].append(value)
    for title, unit, values in (
        ("state: p50", "us", p50),
        ("state: p99", "us", p99),
        ("state: lost", "", lost),
        ("pictures and clouds that arrived", "%", arrived),
    ):
        yield from (Row(f"{title}, {case}", unit, values[case]) for case in cases)


def measured_case(
    robot: str, seconds: float, on_one_priority: bool | None
) -> tuple[float, float, int, float]:
    """p50 and p99 [us] and lost joint states, and the percentage of bulk data that arrived."""
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    with ExitStack() as opened:
        opened.enter_context(running_command("router", "--listen", endpoint, text="listens"))
        where = {"robot": robot, "endpoint": endpoint}
        opened.enter_context(running_role(publish_states, **where))
        if on_one_priority is not None:
            sensors = [f"camera{n}" for n in range(CAMERAS)] + [LIDAR]
            for sensor in sensors:
                task = {"sensor": sensor, "on_one_priority": on_one_priority, **where}
                opened.enter_context(running_role(publish_bulk, **task))
            bulk = opened.enter_context(running_role(read_bulk, seconds=seconds, **where))
        states = opened.enter_context(running_role(read_states, seconds=seconds, **where))
        latencies, lost = result_of(states, 3.0 * seconds + 20.0)
        arrived = 100.0 if on_one_priority is None else result_of(bulk, 3.0 * seconds + 20.0)
    return *np.percentile(latencies, (50, 99)).tolist(), lost, arrived


def publish_states(robot: str, endpoint: str) -> None:
    """The robot, until the end of input."""
    model, ended = load_model(robot), end_of_input()
    source = SineSource(model)
    with connect(mode="client", endpoints=endpoint) as session, StatePublisher(session, model) as publisher:
        threading.Thread(target=lambda: ended.wait() and publisher.close(), daemon=True).start()
        send_event("ready")
        publisher.run(source, STATE_HZ)


def publish_bulk(robot: str, endpoint: str, sensor: str, *, on_one_priority: bool) -> None:
    """A camera or the lidar, until the end of input."""
    ended = end_of_input()
    if on_one_priority:
        open_one = KeyPublisher.__init__
        KeyPublisher.__init__ = lambda self, *arguments, **_: open_one(self, *arguments)
    with connect(mode="client", endpoints=endpoint) as session:
        if sensor == LIDAR:
            publisher, sample, rate_hz = CloudPublisher(session, robot, sensor), sweep(), LIDAR_HZ
        else:
            publisher, sample, rate_hz = CameraPublisher(session, robot, sensor), picture(), CAMERA_HZ
        with publisher:
            send_event("ready")
            begin, tick = time.monotonic(), 0
            while not ended.wait(max(0.0, begin + tick / rate_hz - time.monotonic())):
                publisher.publish(sample)
                tick += 1


def sweep() -> NDArray[np.void]:
    """130,048 points of 22 bytes."""
    lidar = SimulatedLidar()
    return lidar.cloud(0, [(0.0, 0.0, 1.2, 0.0, 0.0, 0.0, 1.0) for _ in lidar.stamps(0)]).points


def during(listener: StreamListener, seconds: float) -> list[ReceivedMessage]:
    """What arrives within some seconds, from the second second on."""
    begin = time.monotonic() + 1.0
    received = []
    while (left := begin + seconds - time.monotonic()) > 0.0:
        one = listener.get(left)
        if one is not None and time.monotonic() > begin:
            received.append(one)
    return received


def picture() -> bytes:
    """A JPEG of 1280x720 of about 120 kB, as of a textured scene."""
    noise = np.random.default_rng(1).integers(0, 110, (360, 640, 3), dtype=np.uint8)
    return simplejpeg.encode_jpeg(np.repeat(np.repeat(noise, 2, 0), 2, 1), quality=80)


def read_states(robot: str, endpoint: str, seconds: float) -> tuple[list[float], int]:
    """The latencies of the joint states of some seconds [us], and how many were lost."""
    with (
        connect(mode="client", endpoints=endpoint) as session,
        StreamListener(session, robot, "joint_states") as listener,
    ):
        send_event("ready")
        arrived = during(listener, seconds)
    numbers = [one.message.seq for one in arrived]
    latencies = [(one.received_at - one.message.stamp) * 1e-3 for one in arrived]
    return latencies, numbers[-1] - numbers[0] + 1 - len(numbers)


def read_bulk(robot: str, endpoint: str, seconds: float) -> float:
    """The percentage of pictures and clouds that arrive within some seconds."""
    with (
        connect(mode="client", endpoints=endpoint) as session,
        StreamListener(session, robot, "image") as pictures,
        StreamListener(session, robot, "cloud") as clouds,
    ):
        send_event("ready")
        both = [(pictures, CAMERAS * CAMERA_HZ), (clouds, LIDAR_HZ)]
        with ThreadPoolExecutor() as pool:
            counts = list(pool.map(lambda one: len(during(one[0], seconds)), both))
    return 100.0 * sum(counts) / (seconds * sum(rate for _, rate in both))
