"""Publishers of laser scans and of maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from zstate.clock import Clock, check_stamp
from zstate.errors import InvalidInput
from zstate.net.session import Session
from zstate.net.writer import write_all
from zstate.nodes.measurement_publisher import MeasurementPublisher
from zstate.nodes.robot_writer import RobotWriter
from zstate.nodes.static_publisher import ValuePublisher
from zstate.rate import RateReport
from zstate.scans.grid import Grid, grid_to_message
from zstate.scans.scan import Scan, scan_to_message
from zstate.wire.keys import check_writer, full_name


class RangeSource(Protocol):
    """Interface of programs that measure ranges: lidar drivers, simulators."""

    def read(self, stamp: int) -> Scan | ArrayLike | None:
        """The ranges [m] of the sweep whose last ray is at ``stamp`` [ns]; None when there is nothing new.

        A source that stamps its sweeps itself returns a Scan, with the geometry and the frame of the
        publisher.
        """
        ...


class ScanPublisher(MeasurementPublisher):
    """Publishes the scans of one laser scanner of a robot, whose geometry is given once.

    ``sensor`` is the scanner's name, in ROS its topic. Its frame is ``frame``, by default a frame of the
    sensor's name; a bare name is the robot's own. ``angle_min`` and ``angle_increment`` [rad], ``range_min``
    and ``range_max`` [m] and ``ray_ns`` [ns] are those of a ``Scan``. Leave ``ray_ns`` out only if the sensor
    measures all rays at once, or does not tell their times: listeners then place each scan rigidly.

    ``wires`` are what it publishes on, "native" (the default), "ros2" with options, or several. ``clock``
    gives the stamps of scans without one; default: the system's. ``program`` is the writer's name for others;
    default: the script's name.

    Under congestion scans are dropped, and joining listeners receive none from the past. On the native wire
    each sensor has one writer: SecondWriter, which names the first one, is raised if another writer publishes
    it, or by ``publish`` if both opened at once, which closes the later one. A context manager; safe from any
    thread.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        sensor: str,
        wires: str | Sequence[str] = ("native",),
        *,
        angle_min: float,
        angle_increment: float,
        range_min: float,
        range_max: float,
        ray_ns: int = 0,
        frame: str | None = None,
        clock: Clock | None = None,
        program: str = "",
    ) -> None:
        self.frame = sensor if frame is None else frame
        self._angles = angle_min, angle_increment, ray_ns
        self._limits_m = range_min, range_max
        self._empty = self._scan(0, [range_max, range_max], None)  # raises here, where the mistake is made
        super().__init__(session, robot, "scan", sensor, wires=wires, clock=clock, program=program)

    def _scan(self, stamp: int, ranges: ArrayLike, intensities: ArrayLike | None) -> Scan:
        return Scan(stamp, *self._angles, ranges, *self._limits_m, self.frame, intensities)

    def publish(
        self, ranges: ArrayLike, stamp: int | None = None, intensities: ArrayLike | None = None
    ) -> None:
        """Publish one scan: ``ranges`` [m] and ``intensities`` of its rays, both (N,).

        ``stamp`` [ns] is the instant of the first ray; by default the scan ends now. A range that is no
        measurement is inf without an echo, -inf if it is too near, and NaN if it is invalid (REP 117). Raises
        InvalidInput for other shapes, SecondWriter and Closed. If it raises, nothing was sent.
        """
        with self._refusals:
            stamp = self._first_stamp(self._clock.now(), ranges) if stamp is None else check_stamp(stamp)
            scan = self._scan(stamp, ranges, intensities)
            self._send(scan_to_message(scan, scan_ns=self._scan_ns()))

    def _first_stamp(self, last: int, ranges: ArrayLike) -> int:
        """The instant of the first ray of a sweep whose last ray is at ``last``."""
        *_, ray_ns = self._angles
        return last - ray_ns * max(np.size(ranges) - 1, 0)

    def _scan_ns(self) -> int:
        return 0 if self._rate is None else round(1e9 / self._rate.report().commanded_hz)

    def _check_geometry(self, sweep: Scan) -> None:
        own, other = _geometry(self._empty, self.robot), _geometry(sweep, self.robot)
        wrong = [name for name in own if own[name] != other[name]]
        if wrong:
            raise InvalidInput(
                f"the scan publisher {self.sensor!r} has "
                f"{', '.join(f'{name}={own[name]!r}' for name in wrong)}; its source returned a Scan with "
                f"{', '.join(f'{name}={other[name]!r}' for name in wrong)}: open the publisher with the "
                "geometry and the frame of its source"
            )

    def run(self, source: RangeSource, rate_hz: float = 30.0, *, seconds: float | None = None) -> RateReport:
        """Publish the sweeps of ``source`` at exactly ``rate_hz``, for ``seconds`` or until ``close()``.

        Each sweep ends at its tick, unless ``source`` returns a Scan. Raises as ``publish``, and InvalidInput
        for a Scan of another geometry or frame; late ticks are those of ``StatePublisher.run``.
        """

        def publish(sweep: Scan | ArrayLike, now: int) -> None:
            if not isinstance(sweep, Scan):
                self.publish(sweep, self._first_stamp(now, sweep))
                return
            self._check_geometry(sweep)
            self.publish(sweep.ranges, sweep.stamp, sweep.intensities)

        return self._publish_at(rate_hz, seconds, source.read, publish)


def _geometry(scan: Scan, robot: str) -> dict[str, object]:
    """What all scans of one sensor have in common."""
    return {
        "angle_min": scan.angle_min,
        "angle_increment": scan.angle_increment,
        "ray_ns": scan.ray_ns,
        "range_min": scan.range_min,
        "range_max": scan.range_max,
        "frame": full_name(robot, scan.frame),
    }


class MapPublisher(ValuePublisher):
    """Publishes the map of a place, latched: listeners that join later receive it as well.

    A place is a robot, whose name is that of the place ("hall"), or a map that a robot has made. The frame of
    the map is ``frame`` if it is given, else that of the grid. ``writer`` distinguishes maps of one robot.
    ``wires`` and ``program`` as of ``ScanPublisher``.
    ``close()`` withdraws the map; the ROS wires cannot express that. On the native wire SecondWriter, which
    names the first writer, is raised if another active writer publishes this map. A context manager.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        grid: Grid,
        wires: str | Sequence[str] = ("native",),
        *,
        frame: str | None = None,
        writer: str = "map",
        program: str = "",
    ) -> None:
        self._frame = frame
        out = RobotWriter(session, robot, wires, program)
        out.title = f"the map publisher {writer!r}"
        super().__init__(out, "map", check_writer(writer))
        with out.opening():
            self.set(grid)

    def __repr__(self) -> str:
        closed = ", closed" if self._out.is_closed else ""
        return f"<MapPublisher {self.writer!r} of {self.robot!r}: {self.grid!r}{closed}>"

    def set(self, grid: Grid) -> None:
        """Replace the map. Raises InvalidInput if it is larger than a message may be, and Closed."""
        out = self._out
        with out.lock:
            out.check_open()
            if self._frame not in (None, grid.frame):
                grid = Grid(grid.cells, grid.resolution, grid.origin.pose7, self._frame, grid.stamp)
            write_all(self._latched, grid_to_message(grid, out.session_id))
            self.grid = grid
