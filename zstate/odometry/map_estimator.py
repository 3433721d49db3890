"""MapEstimator: where a robot is in a map, from its odometry and fixes of GPS receivers.

Two estimators fuse the same events. That of the odometry knows no fix, so its pose stays continuous. That of
the map begins as a copy of it, as soon as the yaw of the odometry in the map is known, and takes the fixes as
positions of the antenna. map -> odom is the difference of both at one stamp (REP 105), so it may jump.

- The yaw is found by the way driven (``map_alignment.py``), from any heading, at rest or in motion. Before
  its standard deviation is below 0.3 rad there is no pose in the map: a filter would not find back from a
  yaw that is wrong by more.
- Errors of a fix wander: they are correlated over ``FixNoise.correlated_s``. A filter takes errors as
  independent, so the variance of each fix is multiplied by (1 + a) / (1 - a), a = exp(-dt / correlated_s)
  with dt the time since the last one. The mean of many is then as uncertain as it is.
- A fix is refused if it is further than the gate of its source, by default 99.9 %, from where the base is in
  the map; if it jumps from the last one, less the way driven, by more than a fix is uncertain; or if over
  half a minute the fixes leave the way by wheels and gyro, with the yaw in the map from before: a drift takes
  that with it. After a drift, all are refused.
- Fixes that are refused, but agree with each other and the way for ``correlated_s`` and 20 m, or for twice
  that time, are believed: the pose in the map moves there, and velocity and biases stay.
- The height of a fix has gates of its own: one that is refused leaves its position in use. It is believed as
  fixes are. A slow drift of the height is followed.
- A drift across the way is as an error of the yaw: if the yaw is not known well, it is followed for a while.
"""

from __future__ import annotations

import math
from bisect import insort
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from zstate._util.format import format_duration
from zstate.buffer.buffer import TransformBuffer
from zstate.checks import Floats, real_numbers
from zstate.clock import check_stamp
from zstate.errors import InPast, InvalidInput, LookupFailed, NoData
from zstate.odometry.estimator import BaseEstimator, BaseState
from zstate.odometry.geodesy import SAME_DATUM_M, Datum, check_place
from zstate.odometry.health import WINDOW, SourceHealth, chi_square_quantile, gate
from zstate.odometry.map_alignment import Fixes, MapAlignment, align_in_map, turn
from zstate.odometry.rotations import skew
from zstate.odometry.source_noise import HEIGHT_FACTOR, FixNoise
from zstate.transform import Transform

_MOST_YAW_SIGMA = 0.3
"""[rad] From there on, a filter is consistent."""
_MOST_YAW_GROWN = 0.15
"""[rad] The odometry loses its yaw: fixes from before it lost so much do not align the map any more."""
_MOST_SIGMA = 100.0
"""[m] A fix that is more uncertain is of no use for a robot."""
_MOST_ALIGNED = 60
"""So many fixes align the map; if there are more, every second one is left out."""
_ALIGNED_APART_M, _ALIGNED_APART_S = 0.5, 5.0
"""Fixes that align it are so far from each other, or so long after each other."""
_MOST_WAITING = _MOST_KEPT = 1000
_KEPT_APART = 1.0 / 200.0
"""Of the time over which fixes are compared, those that are kept are apart by this part."""
_LEVEL = 0.01
"""[rad] Roll and pitch are those of the odometry."""

_WAY = 0.02
"""Of the length of a way by wheels, its error is about this part: ``VelocityNoise.scale``."""
_WANDER_S = (25.0, 40.0)
"""Over such a time, fixes that are honest do not leave the way by more than the gate."""
_UNPROVEN = 4.0
"""By how much the variance of fixes is larger than stated, before it was seen: stated are good conditions."""
_EXCESS_S, _MOST_EXCESS, _LEAST_EXCESS = 60.0, 25.0, 1.0
"""It is averaged for so long, and has these limits."""
_BELIEVED_WAY, _BELIEVED_COUNT, _BELIEVED_GATE = 20.0, 10, 0.95
"""Of fixes that were refused: [m], how many they are at least, and how well they agree. By a wider gate, and
in less time, a drift of 0.5 m/s would agree with a way whose yaw is uncertain."""
_REPORTED_NS = 30_000_000_000
_AHEAD_NS = 1_000_000_000
_UNKNOWN_HEIGHT = 1e4
"""[m] The standard deviation of a height that was not measured."""


class MapState(NamedTuple):
    """``map_from_base`` and ``map_from_odom`` at ``stamp`` [ns].

    ``covariance`` (6, 6) is that of ``map_from_base``, as of ``Transform.covariance``. ``map_from_odom``
    turns about the vertical only, as gravity shows roll and pitch of both; it has no covariance, as the error
    of ``map_from_base`` is not the sum of its own and that of the odometry.
    """

    stamp: int
    map_from_base: Transform
    map_from_odom: Transform
    covariance: Floats


class _Fix(NamedTuple):
    """A fix in the plane of the datum [m], (3,), with its variances [m^2], (3,)."""

    stamp: int
    there: Floats
    variances: Floats
    has_height: bool


class _Turn(NamedTuple):
    """From odom to the map: the rotation in the plane, (2, 2), and the variance of its angle [rad^2]."""

    rotation: Floats
    variance: float


_UNKNOWN_TURN = _Turn(np.eye(2), math.pi**2)


class _Passed(NamedTuple):
    """A fix, and what was at its stamp.

    ``here`` is the antenna in odom [m], (3,), ``way`` the length of its path until then [m], ``state`` that
    of the odometry.
    """

    fix: _Fix
    here: Floats
    way: float
    state: BaseState
    map_from_odom: _Turn


_Square: TypeAlias = Callable[[_Passed, _Passed], float]
"""By how much two fixes do not agree, but for the way, in units of their variances, squared."""


@dataclass(slots=True)
class _Trust:
    """What is known of the errors of fixes in the plane, or of their heights."""

    excess: float = _UNPROVEN
    """By how much their variance is larger than stated."""
    refused: list[_Passed] = field(default_factory=list[_Passed])
    """Those since the last one that was fused that were not, and agree with each other."""
    refused_count: int = 0
    last_refusal: tuple[int, str] = (0, "")
    """When one was last refused, and why."""

    def refuse(self, stamp: int, reason: str) -> None:
        """Count one."""
        self.refused_count += 1
        self.last_refusal = (stamp, reason)

    def believes(self, passed: _Passed, square: _Square, dimension: int, noise: FixNoise) -> bool:
        """Whether ``passed``, which is refused, and those before agree for so long that they are right."""
        run = self.refused
        if run and square(run[0], passed) > chi_square_quantile(_BELIEVED_GATE, dimension):
            run.clear()
        run.append(passed)
        del run[1 : 1 - _BELIEVED_COUNT]
        return _is_believed(run, noise)

    def learn(self, receiver: _Receiver, passed: _Passed, square: _Square, dimension: int) -> None:
        """Average ``excess``, by the change of the errors in some time; ``passed`` is not taken yet."""
        tau_s = receiver.noise.correlated_s
        for earlier in reversed(receiver.taken):
            elapsed_s = (passed.fix.stamp - earlier.fix.stamp) * 1e-9
            if elapsed_s >= tau_s and (dimension == 2 or earlier.fix.has_height):
                break
        else:
            return
        kept = math.exp(-elapsed_s / tau_s)
        seen = min(square(earlier, passed) / (dimension * (1.0 - kept)), _MOST_EXCESS)
        share = 1.0 - math.exp(-(passed.fix.stamp - receiver.taken[-1].fix.stamp) * 1e-9 / _EXCESS_S)
        self.excess = max(self.excess + share * (seen - self.excess), _LEAST_EXCESS)


@dataclass(slots=True)
class _Receiver:
    """What is kept of one receiver, with its antenna at ``lever`` in the base [m], (3,)."""

    frame: str
    lever: Floats
    noise: FixNoise
    stamps: deque[int] = field(default_factory=lambda: deque[int](maxlen=WINDOW))
    """Of the last fixes, in the order of arrival."""
    waiting: list[_Fix] = field(default_factory=list[_Fix])
    """Newer than the odometry, by stamp."""
    last: _Passed | None = None
    """The last one of all."""
    aligning: list[_Passed] = field(default_factory=list[_Passed])
    """Those that align the map."""
    taken: deque[_Passed] = field(default_factory=lambda: deque[_Passed](maxlen=_MOST_KEPT))
    """The last ones that were fused."""
    plane: _Trust = field(default_factory=_Trust)
    height: _Trust = field(default_factory=_Trust)
    is_doubted: bool = False
    """They have left the way, as a drift does; then they are taken again once they are believed."""
    refused_jump: float = math.nan
    """A fix that jumps by more [m] than this, in any direction, would have been refused at the last one."""
    accepted_count: int = 0


class MapEstimator:
    """Where the base of ``odometry`` is in ``map``, by fixes; ``datum`` is the origin of the map.

    The odometry gets its events as before, and this its fixes. Without a ``datum``, the first fix is one.
    ``buffer``, that of the odometry, has the mounts of the antennas, which must be static. If the odometry
    restarts, so does the map, around the same datum. Not safe for several threads at once.
    """

    def __init__(
        self, odometry: BaseEstimator, *, map: str, buffer: TransformBuffer, datum: Datum | None = None
    ) -> None:
        self.odometry, self.map, self.datum = odometry, map, datum
        self.contradiction = ""
        """What others say against the datum: a part of the health of each receiver."""
        self._buffer = buffer
        self._receivers: dict[str, _Receiver] = {}
        self._in_map: BaseEstimator | None = None
        self._since = 0
        """When the map began [ns]."""
        self._unaligned = 0
        """Until then the odometry had no pose [ns]."""
        self._epoch, self._placements = odometry.epoch, odometry.placements

    def fix(
        self,
        stamp: int,
        latitude: float,
        longitude: float,
        altitude: float | None = None,
        *,
        covariance: ArrayLike | None = None,
        frame: str,
        source: str = "gps",
        noise: FixNoise = FixNoise(),  # noqa: B008 - frozen
    ) -> None:
        """The position of an antenna, the origin of ``frame``, at ``stamp`` [ns].

        ``latitude`` and ``longitude`` [deg] and ``altitude`` [m], None if it is not known, are those of
        WGS84. ``covariance`` (3, 3) [m^2] is that of east, north, up. ``noise`` takes precedence over it.
        Fixes may come late, as the events of the odometry. One that is newer than they are is used by the
        first call of any method after the odometry has come up to it, which must not be ``history_s`` later.
        Raises InvalidInput, which names the source, for what is no place on the Earth, for (0, 0), which
        receivers without a fix send, and for an unknown noise; UnknownFrame for the frame.
        """
        stamp = check_stamp(stamp)
        self._begin_if_odometry_has()
        receiver = self._receiver(source, frame, noise)
        try:
            check_place(latitude, longitude, altitude or 0.0)
        except InvalidInput as error:
            raise InvalidInput(f"a fix of source {source!r}: {error}") from None
        if latitude == 0.0 and longitude == 0.0:
            raise InvalidInput(
                f"a fix of source {source!r} at latitude 0 and longitude 0: receivers send that without a fix"
            )
        variances = self._variances(source, covariance, noise)
        if variances[0] > _MOST_SIGMA**2:
            receiver.plane.refuse(stamp, f"uncertain by {math.sqrt(variances[0]):.3g} m")
            self._use_waiting()
            return
        if self.datum is None:
            self.datum = Datum(latitude, longitude, altitude or 0.0)
        there = self.datum.enu(latitude, longitude, self.datum.altitude if altitude is None else altitude)
        receiver.stamps.append(stamp)
        insort(
            receiver.waiting, _Fix(stamp, there, variances, altitude is not None), key=lambda one: one.stamp
        )
        del receiver.waiting[:-_MOST_WAITING]
        self._use_waiting()

    def agree(self, datum: Datum, robot: str) -> None:
        """Take the ``datum`` that ``robot`` has given the same map, if there is none yet.

        Raises InvalidInput, with both and their distance, if there is another one.
        """
        if self.datum is None:
            self.datum = datum
        away = self.datum.distance(datum)
        if away > SAME_DATUM_M:
            raise InvalidInput(
                f"the datum of {self.map!r} is {self.datum} here and {datum} of {robot!r}, {away:.2f} m away "
                "(latitude, longitude, altitude): give all robots of a map one --datum"
            )

    def state(self, at: int | None = None) -> MapState:
        """The state at the stamp ``at`` [ns]; by default at the newest event.

        Before the yaw in the map is known, raises NoData, with what is missing; otherwise as
        ``BaseEstimator.state``.
        """
        self._use_waiting()
        if self._in_map is None:
            error = NoData(self.map, self.odometry.base, edge=(self.map, self.odometry.odom), requested=at)
            error.note = self._missing()
            raise error
        if at is not None and at < self._since:
            raise InPast(
                self.map,
                self.odometry.base,
                edge=(self.map, self.odometry.odom),
                requested=check_stamp(at),
                oldest=self._since,
                newest=self.odometry.newest,
            )
        there = self._in_map.state(at)
        here = self.odometry.state(there.stamp)
        yaw = there.odom_from_base.rpy[2] - here.odom_from_base.rpy[2]
        rotation = np.eye(3)
        rotation[:2, :2] = turn(yaw)
        shift = there.odom_from_base.translation - rotation @ here.odom_from_base.translation
        half = 0.5 * yaw
        pose7 = (*shift.tolist(), 0.0, 0.0, math.sin(half), math.cos(half))
        map_from_odom = Transform.from_pose7(self.map, self.odometry.odom, pose7, there.stamp)
        return MapState(there.stamp, there.odom_from_base, map_from_odom, there.covariance.pose)

    def refused_jumps(self) -> dict[str, float]:
        """By receiver, from which jump [m] on its fixes are refused, whatever their direction.

        It is that of its last fix that was used; a receiver without one has none.
        """
        self._use_waiting()
        found = {name: receiver.refused_jump for name, receiver in sorted(self._receivers.items())}
        return {name: jump for name, jump in found.items() if math.isfinite(jump)}

    def health(self) -> tuple[SourceHealth, ...]:
        """The health of each receiver, by name."""
        self._use_waiting()
        newest = self.odometry.newest
        return tuple(
            self._health(name, receiver, newest) for name, receiver in sorted(self._receivers.items())
        )

    def _receiver(self, source: str, frame: str, noise: FixNoise) -> _Receiver:
        found = self._receivers.get(source)
        if found is None:
            base_from_antenna = self._buffer.lookup(self.odometry.base, frame)
            if base_from_antenna.stamp is not None:
                raise InvalidInput(f"the antenna {frame!r} moves on the robot; fixes need a fixed mount")
            lever = base_from_antenna.translation
            found = self._receivers[source] = _Receiver(frame, lever, noise)
        if (frame, noise) != (found.frame, found.noise):
            raise InvalidInput(
                f"source {source!r} has an antenna at {found.frame!r} and one noise; give another receiver "
                "another name"
            )
        return found

    def _variances(self, source: str, covariance: ArrayLike | None, noise: FixNoise) -> Floats:
        """Of x, y and z [m^2], (3,)."""
        if noise.sigmas is not None:
            across, up = noise.sigmas
        else:
            matrix = real_numbers(0.0 if covariance is None else covariance, f"the covariance of {source!r}")
            if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or matrix.diagonal().min() <= 0.0:
                raise InvalidInput(
                    f"fixes of source {source!r} have no covariance (3, 3) with variances above zero: state "
                    "their noise, as FixNoise(sigma=(1.5, 5.0)) [m]"
                )
            across = math.sqrt(float(np.linalg.eigvalsh(matrix[:2, :2])[1]))
            up = math.sqrt(float(matrix[2, 2]))
            up = up if up > across else HEIGHT_FACTOR * across
        least_across, least_up = noise.floors
        across, up = max(across, least_across), max(up, least_up)
        return np.square((across, across, up))

    def _begin_if_odometry_has(self) -> None:
        """Forget fixes of another time, and the map, but for its datum, if the odometry was restarted."""
        if self.odometry.epoch == self._epoch:
            return
        self._epoch, self._in_map, self._unaligned = self.odometry.epoch, None, 0
        for receiver in self._receivers.values():
            for kept in (receiver.waiting, receiver.aligning, receiver.taken):
                kept.clear()
            for trust in (receiver.plane, receiver.height):
                trust.refused.clear()
                trust.last_refusal = (0, "")
            receiver.stamps.clear()
            receiver.last, receiver.is_doubted = None, False

    def _begin_ways_if_odometry_was_placed(self) -> None:
        """Forget where fixes were in odom, if the odometry was moved there by hand; the map stays."""
        if self.odometry.placements == self._placements:
            return
        self._placements = self.odometry.placements
        for receiver in self._receivers.values():
            for kept in (
                receiver.aligning,
                receiver.taken,
                receiver.plane.refused,
                receiver.height.refused,
            ):
                kept.clear()
            receiver.last = None

    def _use_waiting(self) -> None:
        """Use the fixes that the odometry has come up to."""
        self._begin_if_odometry_has()
        self._begin_ways_if_odometry_was_placed()
        newest = self.odometry.newest
        for name, receiver in self._receivers.items():
            while receiver.waiting and receiver.waiting[0].stamp <= newest:
                stamp = receiver.waiting[0].stamp
                try:
                    here = self.odometry.state(stamp)
                    there = None if self._in_map is None else self._in_map.state(max(stamp, self._since))
                except NoData:
                    self._unaligned = newest
                    break
                except LookupFailed:
                    del receiver.waiting[0]
                    if stamp > self._unaligned:
                        receiver.plane.refuse(stamp, "too late; raise history_s")
                    continue
                passed = _passed(receiver, receiver.waiting.pop(0), here, there)
                if there is None:
                    self._align(receiver, passed)
                elif stamp >= self._since:
                    self._fuse(there, name, receiver, passed)

    def _align(self, receiver: _Receiver, passed: _Passed) -> None:
        kept = receiver.aligning
        if kept and not _is_apart(kept[-1], passed):
            return
        kept.append(passed)
        if len(kept) > _MOST_ALIGNED:
            del kept[1:-1:2]
        now = self.odometry.state()
        while _grown(kept, now)[5] > _MOST_YAW_GROWN**2:
            del kept[0]
        alignment = self._alignment(receiver)
        if alignment.misfit > gate(max(alignment.freedom, 1), receiver.noise.gate):
            receiver.plane.refuse(passed.fix.stamp, "not where wheels and gyro lead from earlier ones")
            del kept[:-1]
            return
        grown = _grown(kept, now)
        if alignment.yaw_variance + grown[5] > _MOST_YAW_SIGMA**2:
            return
        base = now.odom_from_base
        known = np.diag((0.0, 0.0, grown[2], _LEVEL**2, _LEVEL**2, grown[5]))
        turned = _Turn(turn(alignment.yaw), alignment.yaw_variance)
        known[:2, :2] = turned.rotation @ np.diag(grown[:2]) @ turned.rotation.T
        known[np.ix_((0, 1, 5), (0, 1, 5))] += alignment.covariance(base.translation[:2])
        heights = [one.fix.there[2] - one.here[2] for one in kept if one.fix.has_height]
        variance = receiver.height.excess * max(one.fix.variances[2] for one in kept)
        known[2, 2] += variance if heights else _UNKNOWN_HEIGHT**2
        height = float(np.median(heights)) if heights else 0.0
        place = (*alignment.place(base.translation[:2]).tolist(), float(base.translation[2]) + height)
        rotation = (0.0, 0.0, base.rpy[2] + alignment.yaw)
        self._in_map, self._since = self.odometry.follower(self.map), now.stamp
        self._in_map.set_pose(
            Transform.from_rpy(self.map, self.odometry.base, place, rotation).with_covariance(known)
        )
        receiver.taken.append(passed._replace(map_from_odom=turned))

    def _alignment(self, receiver: _Receiver) -> MapAlignment:
        kept = receiver.aligning
        fixes = Fixes(
            np.array([(one.fix.stamp - kept[0].fix.stamp) * 1e-9 for one in kept]),
            np.array([one.fix.there[:2] for one in kept]),
            np.array([one.here[:2] for one in kept]),
            receiver.plane.excess * np.array([one.fix.variances[0] for one in kept]),
        )
        return align_in_map(fixes, receiver.noise.correlated_s)

    def _fuse(self, there: BaseState, name: str, receiver: _Receiver, passed: _Passed) -> None:
        """Fuse a fix, or refuse it; ``there`` is the state in the map at its stamp."""
        fix, in_map = passed.fix, self._in_map
        assert in_map is not None
        if _is_known(receiver, fix):
            return
        plane, height, noise = receiver.plane, receiver.height, receiver.noise
        antenna = _point(there.odom_from_base, receiver.lever)
        covariance = _point_covariance(there, receiver.lever)
        away = fix.there - antenna
        reason = _contradiction(receiver, passed, away, covariance)
        if not reason:
            reason = _drift(receiver, passed)
            receiver.is_doubted = receiver.is_doubted or bool(reason)
        if not reason and receiver.is_doubted:
            reason = "not along the way by wheels and gyro for long enough, since they have left it"
        if reason:
            plane.refuse(fix.stamp, reason)
            if plane.believes(passed, _square, 2, noise):
                self._believe(in_map, plane, passed, away * (1.0, 1.0, 0.0))
                receiver.accepted_count += 1
                receiver.is_doubted = False
                receiver.taken.clear()  # the jump from earlier ones is no error of those to come
                receiver.taken.append(passed)
            return
        receiver.accepted_count += 1
        plane.refused.clear()
        reason = _wrong_height(receiver, passed, away[2], covariance[2, 2]) if fix.has_height else ""
        if reason:
            height.refuse(fix.stamp, reason)
            if height.believes(passed, _square_of_heights, 1, noise):
                self._believe(in_map, height, passed, away * (0.0, 0.0, 1.0))
                receiver.taken = deque((_without_height(one) for one in receiver.taken), _MOST_KEPT)
                receiver.taken.append(passed)
                return
            passed = _without_height(passed)
            fix = passed.fix
        factor = _correlation_factor(receiver, fix)
        measured, variances = fix.there.copy(), factor * plane.excess * fix.variances
        variances[2] = factor * height.excess * fix.variances[2]
        if not fix.has_height:
            measured[2], variances[2] = antenna[2], _UNKNOWN_HEIGHT**2
        in_map.position(
            fix.stamp, measured, np.diag(variances), source=name, frame=receiver.frame, gate=noise.gate
        )
        receiver.refused_jump = _refused_jump(receiver, passed, covariance)
        taken = receiver.taken
        if taken and fix.stamp < taken[-1].fix.stamp:
            return  # later ones are compared with the last one
        plane.learn(receiver, passed, _square, 2)
        if fix.has_height:
            height.refused.clear()
            height.learn(receiver, passed, _square_of_heights, 1)
        apart_ns = _KEPT_APART * 1e9 * max(_WANDER_S[1], noise.correlated_s)
        if len(taken) > 1 and taken[-1].fix.stamp - taken[-2].fix.stamp < apart_ns:
            taken.pop()
        taken.append(passed)

    def _believe(self, in_map: BaseEstimator, trust: _Trust, passed: _Passed, away: Floats) -> None:
        """Move the base in the map by ``away`` [m], (3,), to where fixes, or heights, agree that it is.

        It is placed at the newest stamp, so a position at the stamp of the fix would be of no effect.
        """
        newest = in_map.state()
        pose, known = newest.odom_from_base, newest.covariance.pose.copy()
        trust.excess = max(trust.excess, _UNPROVEN)
        known[:3, :3] += trust.excess * np.diag(np.where(away == 0.0, 0.0, passed.fix.variances))
        place = pose.translation + away
        moved = Transform.from_pose7(
            self.map, self.odometry.base, (*place.tolist(), *pose.pose7[3:].tolist())
        )
        in_map.set_pose(moved.with_covariance(known))
        trust.refused.clear()

    def _missing(self) -> str:
        if not any(receiver.aligning for receiver in self._receivers.values()):
            return "no fix yet at a known pose of the odometry"
        variance = min(
            self._alignment(receiver).yaw_variance
            + float(_grown(receiver.aligning, receiver.aligning[-1].state)[5])
            for receiver in self._receivers.values()
            if receiver.aligning
        )
        if variance > math.pi**2:
            return "the yaw of the odometry in the map is not known; drive some metres"
        degrees, least = (math.degrees(angle) for angle in (math.sqrt(variance), _MOST_YAW_SIGMA))
        return (
            f"the yaw of the odometry in the map is known to {degrees:.1f} degrees; drive on, until it is "
            f"known to {least:.1f}"
        )

    def _health(self, name: str, receiver: _Receiver, newest: int) -> SourceHealth:
        stamps = receiver.stamps
        span = max(stamps) - min(stamps) if stamps else 0
        rate = (len(stamps) - 1) / (span * 1e-9) if span else 0.0
        age_s = (newest - max(stamps)) * 1e-9 if stamps else math.inf
        found = [self.contradiction] if self.contradiction else []
        if self._in_map is None:
            found.append(self._missing())
        for trust, what in ((receiver.plane, "fixes refused"), (receiver.height, "heights refused")):
            at, reason = trust.last_refusal
            if reason and newest - at < _REPORTED_NS:
                found.append(f"{trust.refused_count} {what}, the last one as it is {reason}")
        if newest and stamps and max(stamps) - newest > _AHEAD_NS:
            ahead = format_duration(max(stamps) - newest)
            found.append(
                f"its last fix is stamped {ahead} after the newest event of the odometry and waits for it: "
                "one of the two clocks is wrong, or the odometry has no more events"
            )
        sentence = f"{name}: {'; '.join(found)}" if found else ""
        return SourceHealth(
            name,
            rate,
            age_s,
            math.nan,
            (math.nan, math.nan),
            0,
            receiver.accepted_count,
            receiver.plane.refused_count,
            0,
            0,
            sentence,
        )


def _point(world_from_base: Transform, lever: Floats) -> Floats:
    return world_from_base.translation + world_from_base.matrix[:3, :3] @ lever


def _point_covariance(state: BaseState, lever: Floats) -> Floats:
    """That of the antenna in the world [m^2], (3, 3)."""
    jacobian = np.hstack((np.eye(3), -skew(state.odom_from_base.matrix[:3, :3] @ lever)))
    return jacobian @ state.covariance.pose @ jacobian.T


def _passed(receiver: _Receiver, fix: _Fix, odom: BaseState, in_map: BaseState | None) -> _Passed:
    """A fix with the states at its stamp."""
    here, last = _point(odom.odom_from_base, receiver.lever), receiver.last
    way = 0.0 if last is None else last.way + float(np.hypot(*(here - last.here)[:2]))
    receiver.last = _Passed(fix, here, way, odom, _turn_between(odom, in_map))
    return receiver.last


def _turn_between(odom: BaseState, in_map: BaseState | None) -> _Turn:
    """That from odom to the map, by states at one stamp."""
    if in_map is None:
        return _UNKNOWN_TURN
    yaw = in_map.odom_from_base.rpy[2] - odom.odom_from_base.rpy[2]
    return _Turn(turn(yaw), float(in_map.covariance.pose[5, 5]))


def _grown(kept: list[_Passed], now: BaseState) -> Floats:
    """By how much the variances of the pose in odom have grown since the first of the fixes, (6,)."""
    return np.maximum(now.covariance.pose.diagonal() - kept[0].state.covariance.pose.diagonal(), 0.0)


def _is_known(receiver: _Receiver, fix: _Fix) -> bool:
    """Whether it is the same fix again, as after a reconnection."""
    same = (one.fix.stamp for one in reversed(receiver.taken) if one.fix.stamp <= fix.stamp)
    return next(same, None) == fix.stamp


def _is_apart(last: _Passed, passed: _Passed) -> bool:
    way = float(np.hypot(*(passed.here - last.here)[:2]))
    return way >= _ALIGNED_APART_M or passed.fix.stamp - last.fix.stamp >= _ALIGNED_APART_S * 1e9


def _difference(first: _Passed, second: _Passed, excess: float = 1.0) -> tuple[Floats, Floats]:
    """By how much the way between two fixes is not that by wheels and gyro [m], (2,), and its covariance.

    The covariance is of both fixes, with ``excess`` times their variances, and of the way. The yaw in the map
    is that at the first one: fixes that drift away take the yaw with them, and agree with a later one.
    """
    rotation, variance = first.map_from_odom
    variance += max(float(second.state.covariance.pose[5, 5] - first.state.covariance.pose[5, 5]), 0.0)
    way = rotation @ (second.here - first.here)[:2]
    apart = (second.fix.there - first.fix.there)[:2] - way
    across = np.array((-way[1], way[0]))
    of_way = (_WAY * (second.way - first.way)) ** 2
    of_each = excess * (first.fix.variances[0] + second.fix.variances[0]) + of_way
    return apart, of_each * np.eye(2) + variance * np.outer(across, across)


def _mahalanobis(apart: Floats, covariance: Floats) -> float:
    """The square of the distance."""
    return float(apart @ np.linalg.solve(covariance, apart))


def _square(first: _Passed, second: _Passed, excess: float = 1.0) -> float:
    """The square of ``_difference`` in units of its covariance."""
    return _mahalanobis(*_difference(first, second, excess))


def _rise(first: _Passed, second: _Passed) -> float:
    """By how much the difference of two heights is not that by the odometry [m]."""
    return float((second.fix.there - first.fix.there)[2] - (second.here - first.here)[2])


def _square_of_heights(first: _Passed, second: _Passed, excess: float = 1.0) -> float:
    """The square of ``_rise`` in units of its variance."""
    variance = excess * (first.fix.variances[2] + second.fix.variances[2])
    return _rise(first, second) ** 2 / (variance + (_WAY * (second.way - first.way)) ** 2)


def _without_height(passed: _Passed) -> _Passed:
    return passed._replace(fix=passed.fix._replace(has_height=False))


def _contradiction(receiver: _Receiver, passed: _Passed, away: Floats, covariance: Floats) -> str:
    """By what a fix contradicts the pose in the map, or the fix before; empty if it does not.

    It is ``away`` [m] from where the antenna is with ``covariance``; of both the plane counts.
    """
    most, excess = gate(2, receiver.noise.gate), receiver.plane.excess
    if _mahalanobis(away[:2], covariance[:2, :2] + excess * np.diag(passed.fix.variances[:2])) > most:
        return f"{np.hypot(*away[:2]):.1f} m from where wheels, gyro and earlier fixes lead"
    if receiver.taken:
        last = receiver.taken[-1]
        if _square(last, passed, excess) > _share(receiver, last, passed) * most:
            jump, _ = _difference(last, passed)
            return f"{np.hypot(*jump):.1f} m from the one before, but for the way by wheels and gyro"
    return ""


def _wrong_height(receiver: _Receiver, passed: _Passed, away: float, variance: float) -> str:
    """The same of the height of a fix."""
    most, excess = gate(1, receiver.noise.gate), receiver.height.excess
    if away**2 > most * (variance + excess * passed.fix.variances[2]):
        return f"{abs(away):.1f} m from where earlier ones and the odometry lead"
    last = next((one for one in reversed(receiver.taken) if one.fix.has_height), None)
    if last is not None and _square_of_heights(last, passed, excess) > _share(receiver, last, passed) * most:
        return f"{abs(_rise(last, passed)):.1f} m from the one before, but for the way by the odometry"
    return ""


def _share(receiver: _Receiver, last: _Passed, passed: _Passed) -> float:
    """Of the variance of a difference: errors of neighbours are alike."""
    elapsed_s = (passed.fix.stamp - last.fix.stamp) * 1e-9
    return 0.5 if elapsed_s < receiver.noise.correlated_s else 1.0


def _refused_jump(receiver: _Receiver, passed: _Passed, covariance: Floats) -> float:
    """From which distance [m] on a fix in place of this one contradicts, whatever its direction."""
    excess = receiver.plane.excess
    in_place = covariance[:2, :2] + excess * np.diag(passed.fix.variances[:2])
    squares = [float(np.linalg.eigvalsh(in_place)[-1])]
    if receiver.taken:
        last = receiver.taken[-1]
        _, between = _difference(last, passed, excess)
        squares.append(_share(receiver, last, passed) * float(np.linalg.eigvalsh(between)[-1]))
    return math.sqrt(gate(2, receiver.noise.gate) * min(squares))


def _drift(receiver: _Receiver, passed: _Passed) -> str:
    """By how much fixes have left the way in half a minute; empty if no more than honest ones do."""
    for earlier in receiver.taken:
        elapsed_s = (passed.fix.stamp - earlier.fix.stamp) * 1e-9
        if _WANDER_S[0] <= elapsed_s <= _WANDER_S[1]:
            wander, covariance = _difference(earlier, passed, _UNPROVEN)
            if _mahalanobis(wander, covariance) > gate(2, receiver.noise.gate):
                off = np.hypot(*wander)
                return f"{off:.1f} m off the way by wheels and gyro since one {elapsed_s:.0f} s before"
            break
    return ""


def _is_believed(run: list[_Passed], noise: FixNoise) -> bool:
    """Whether fixes that were refused, and agree, are right after all."""
    way = float(np.hypot(*(run[-1].here - run[0].here)[:2]))
    elapsed_s = (run[-1].fix.stamp - run[0].fix.stamp) * 1e-9
    least_s = noise.correlated_s if way >= _BELIEVED_WAY else 2.0 * noise.correlated_s
    return len(run) >= _BELIEVED_COUNT and elapsed_s >= least_s


def _correlation_factor(receiver: _Receiver, fix: _Fix) -> float:
    """By how much the variance of a fix counts more, as its error is that of the last one."""
    if not receiver.taken:
        return 1.0
    elapsed_s = abs(fix.stamp - receiver.taken[-1].fix.stamp) * 1e-9
    kept = math.exp(-elapsed_s / receiver.noise.correlated_s)
    return (1.0 + kept) / (1.0 - kept)
