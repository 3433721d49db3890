"""Publisher of point clouds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.checks import check_names
from zstate.clock import Clock, check_stamp, check_stamps
from zstate.clouds.cloud import TIME_FIELDS, Cloud, cloud_to_message
from zstate.clouds.messages import check_counts
from zstate.errors import InvalidInput
from zstate.net.session import Session
from zstate.nodes.measurement_publisher import MeasurementPublisher
from zstate.rate import RateReport
from zstate.wire.keys import full_name

_XYZ = np.dtype([(name, "<f4") for name in "xyz"])
_AXES = 3
_TIME = "t"
_LONGEST_NS = 2**32 - 1


class CloudSource(Protocol):
    """Interface of programs that measure clouds: lidar drivers, depth cameras, simulators."""

    def read(self, stamp: int) -> Cloud | None:
        """The newest cloud at ``stamp`` [ns]; None when there is nothing new."""
        ...


class CloudPublisher(MeasurementPublisher):
    """Publishes the clouds of one sensor of a robot.

    ``sensor`` is its name, in ROS its topic. Its frame is ``frame``, by default a frame of the sensor's name;
    a bare name is the robot's own.

    ``compression``, "lz4" or "zstd", is for networks that are slower than it: Zstandard takes a third longer
    than LZ4, for 13 to 45 % fewer bytes. Nothing is lost unless a ``resolution`` [m] is given: x, y and z are
    rounded to its multiples, and change by half of it at most. On the wires of ROS, which have no
    compression, clouds are rounded in the same way.

    Clouds give way to all other streams: they are sent after them, and under congestion dropped. Joining
    listeners receive none from the past. On the native wire each sensor has one writer: SecondWriter, which
    names the first one, is raised if another writer publishes it, or by ``publish`` if both opened at once,
    which closes the later one. ``program`` is the script's name by default. A context manager; safe from any
    thread.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        sensor: str,
        wires: str | Sequence[str] = ("native",),
        *,
        frame: str | None = None,
        compression: Literal["lz4", "zstd"] | None = None,
        resolution: float | None = None,
        clock: Clock | None = None,
        program: str = "",
    ) -> None:
        self.frame = sensor if frame is None else frame
        check_names(self.frame)
        if compression not in (None, "lz4", "zstd"):
            raise InvalidInput(f"the compression of clouds is None, 'lz4' or 'zstd'; got {compression!r}")
        if resolution is not None and (compression is None or not 0.0 < resolution < math.inf):
            raise InvalidInput(
                "resolution is what a compression rounds x, y and z to, positive and finite [m]; got "
                f"resolution={resolution!r} with compression={compression!r}"
            )
        self._compression: Literal["", "lz4", "zstd"] = compression or ""
        self._resolution = resolution or 0.0
        super().__init__(session, robot, "cloud", sensor, wires=wires, clock=clock, program=program)

    def publish(self, points: ArrayLike, stamp: int | None = None, times: ArrayLike | None = None) -> None:
        """Publish one cloud.

        ``points`` are x y z [m], (N, 3) or of an organised cloud (height, width, 3), which are sent as
        float32; or a structured array, (N,) or (height, width), with fields x, y, z and any others, which is
        sent as it is. NaN marks what is no point. ``times`` are the instants of the points [ns], (N,) or
        (height, width), at most 4 s after the first; a structured array may have a field of times instead.

        ``stamp`` [ns] is the instant to which times in a field refer; by default the first of ``times``, or
        now. Raises InvalidInput for other shapes and types, and for more points than a cloud may have;
        SecondWriter; and Closed. If it raises, nothing was sent.
        """
        with self._refusals:
            array = _structured(points)
            if times is not None:
                array, stamp = _with_times(array, times, stamp)
            stamp = self._clock.now() if stamp is None else check_stamp(stamp)
            cloud = Cloud(stamp, self.frame, array)
            is_dense = bool(cloud.valid.all())
            self._send(cloud_to_message(cloud, is_dense, self._compression, self._resolution))

    def run(self, source: CloudSource, rate_hz: float = 10.0, *, seconds: float | None = None) -> RateReport:
        """Publish the clouds of ``source`` at exactly ``rate_hz``, for ``seconds`` or until ``close()``.

        Raises as ``publish``, and InvalidInput for a Cloud in another frame; late ticks are those of
        ``StatePublisher.run``.
        """

        def publish(cloud: Cloud, _: int) -> None:
            own, other = full_name(self.robot, self.frame), full_name(self.robot, cloud.frame)
            if own != other:
                raise InvalidInput(
                    f"the cloud publisher {self.sensor!r} has the frame {own!r}; its source returned a Cloud "
                    f"in {other!r}: open the publisher with the frame of its source"
                )
            self.publish(cloud.points, cloud.stamp)

        return self._publish_at(rate_hz, seconds, source.read, publish)


def _structured(points: ArrayLike) -> NDArray[np.void]:
    """``points`` as a structured array. Raises InvalidInput for other shapes and too many points."""
    array: NDArray[Any] = np.asarray(points)
    if array.dtype.names is not None:
        check_counts(array.size, array.dtype.itemsize)
        return array
    if array.ndim not in (2, 3) or array.shape[-1] != _AXES or array.dtype.kind not in "fiu":
        raise InvalidInput(
            "points of a cloud are numbers of the shape (N, 3) or (height, width, 3), or a structured array "
            f"with fields x, y, z; got {array.dtype} of the shape {array.shape}"
        )
    check_counts(array.size // _AXES, _XYZ.itemsize)
    with np.errstate(over="ignore"):  # numbers beyond float32 become infinite, and no points
        return np.ascontiguousarray(array, dtype=np.float32).view(_XYZ)[..., 0]


def _with_times(
    points: NDArray[np.void], times: ArrayLike, stamp: int | None
) -> tuple[NDArray[np.void], int | None]:
    """``points`` with the field ``t``, nanoseconds since ``stamp``, by default the first of ``times``."""
    own = next((name for name in TIME_FIELDS if name in (points.dtype.names or ())), None)
    if own is not None:
        raise InvalidInput(f"the points have their times in the field {own!r}; leave out times, or the field")
    array = np.asarray(times)
    if array.shape != points.shape:
        raise InvalidInput(f"points of the shape {points.shape} have times of the shape {array.shape}")
    instants = check_stamps(array.ravel())
    if not instants.size:
        return points, stamp
    first = int(instants.min())
    start = first if stamp is None else check_stamp(stamp)
    if first < start or int(instants.max()) - start > _LONGEST_NS:
        raise InvalidInput(
            f"times of a cloud are from its stamp on, at most {_LONGEST_NS} ns later; got {first} to "
            f"{int(instants.max())} with the stamp {start}"
        )
    timed = np.empty(points.shape, [*_described(points.dtype), (_TIME, "<u4")])
    for name in points.dtype.names or ():
        timed[name] = points[name]
    timed[_TIME] = (instants - start).reshape(points.shape)
    return timed, start


def _described(dtype: np.dtype[np.void]) -> list[tuple[str, Any]]:
    """The fields of ``dtype``, one after the other."""
    return [(name, dtype[name]) for name in dtype.names or ()]
