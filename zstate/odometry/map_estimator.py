"""MapEstimator: where a robot is in a map, from its odometry and fixes of GPS receivers.

Two estimators fuse the same events. That of the odometry knows no fix, so its pose stays continuous. That of
the map begins as a copy of it, as soon as the yaw of the odometry in the map is known, and takes the fixes as
positions of the antenna. map -> odom is the difference of both at one stamp (REP 105), so it may jump.

- The yaw is found by the way driven (``map_alignment.py``), from any heading, at rest or in motion. Before
  its standard deviation is below 0.3 rad there is no pose in the map: a filter would not find back from a
  yaw that is wrong by more.
- Which fixes are right is in ``fix_receiver.py``. If those that were refused are believed after all, the pose
  in the map moves there; velocity and biases stay.
- A drift across the way is as an error of the yaw: if the yaw is not known well, it is followed for a while.
"""

from __future__ import annotations

import math
from bisect import insort
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from zstate._util.format import format_duration
from zstate.buffer.buffer import TransformBuffer
from zstate.checks import Floats, real_numbers
from zstate.clock import check_stamp
from zstate.errors import InPast, InvalidInput, LookupFailed, NoData
from zstate.odometry.estimator import BaseEstimator, BaseState
from zstate.odometry.fix_receiver import FixReceiver, FixTrust, PassedFix, PlaneFix, Turn, without_height
from zstate.odometry.geodesy import SAME_DATUM_M, Datum, check_geodetic
from zstate.odometry.health import SourceHealth, gate
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
_MOST_WAITING = 1000
_LEVEL = 0.01
"""[rad] Roll and pitch are those of the odometry."""
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
        self._receivers: dict[str, FixReceiver] = {}
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
        WGS84. ``source`` is the name of the receiver in ``health``. ``covariance`` (3, 3) [m^2] is that of
        east, north, up. ``noise`` takes precedence over it.
        Fixes may come late, as the events of the odometry. One that is newer than they are is used by the
        first call of any method after the odometry has come up to it, which must not be ``history_s`` later.
        Raises InvalidInput, which names the source, for what is no place on the Earth, for (0, 0), which
        receivers without a fix send, and for an unknown noise; UnknownFrame for the frame.
        """
        stamp = check_stamp(stamp)
        self._begin_if_odometry_has()
        receiver = self._receiver(source, frame, noise)
        try:
            check_geodetic(latitude, longitude, altitude or 0.0)
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
            receiver.waiting,
            PlaneFix(stamp, there, variances, altitude is not None),
            key=lambda one: one.stamp,
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

    def _receiver(self, source: str, frame: str, noise: FixNoise) -> FixReceiver:
        found = self._receivers.get(source)
        if found is None:
            base_from_antenna = self._buffer.lookup(self.odometry.base, frame)
            if base_from_antenna.stamp is not None:
                raise InvalidInput(f"the antenna {frame!r} moves on the robot; fixes need a fixed mount")
            lever = base_from_antenna.translation
            found = self._receivers[source] = FixReceiver(frame, lever, noise)
        if (frame, noise) != (found.frame, found.noise):
            raise InvalidInput(
                f"source {source!r} has an antenna at {found.frame!r} and one noise; give another receiver "
                "another name"
            )
        return found

    def _variances(self, source: str, covariance: ArrayLike | None, noise: FixNoise) -> Floats:
        """The variances of x, y and z [m^2], (3,)."""
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
            receiver.begin()

    def _begin_ways_if_odometry_was_placed(self) -> None:
        """Forget where fixes were in odom, if the odometry was moved there by hand; the map stays."""
        if self.odometry.placements == self._placements:
            return
        self._placements = self.odometry.placements
        for receiver in self._receivers.values():
            receiver.begin_way()

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
                passed = receiver.passed(receiver.waiting.pop(0), here, there)
                if there is None:
                    self._align(receiver, passed)
                elif stamp >= self._since:
                    self._fuse(there, name, receiver, passed)

    def _align(self, receiver: FixReceiver, passed: PassedFix) -> None:
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
        turned = Turn(turn(alignment.yaw), alignment.yaw_variance)
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

    def _alignment(self, receiver: FixReceiver) -> MapAlignment:
        kept = receiver.aligning
        fixes = Fixes(
            np.array([(one.fix.stamp - kept[0].fix.stamp) * 1e-9 for one in kept]),
            np.array([one.fix.there[:2] for one in kept]),
            np.array([one.here[:2] for one in kept]),
            receiver.plane.excess * np.array([one.fix.variances[0] for one in kept]),
        )
        return align_in_map(fixes, receiver.noise.correlated_s)

    def _fuse(self, there: BaseState, name: str, receiver: FixReceiver, passed: PassedFix) -> None:
        """Fuse a fix, or refuse it; ``there`` is the state in the map at its stamp."""
        fix, in_map = passed.fix, self._in_map
        assert in_map is not None
        if receiver.is_known(fix):
            return
        pose = there.odom_from_base
        antenna = pose.translation + pose.matrix[:3, :3] @ receiver.lever
        covariance = _point_covariance(there, receiver.lever)
        away = fix.there - antenna
        reason = receiver.reason_against(passed, away, covariance)
        if reason:
            receiver.plane.refuse(fix.stamp, reason)
            if receiver.believes(passed):
                self._believe(in_map, receiver.plane, passed, away * (1.0, 1.0, 0.0))
            return
        receiver.accepted_count += 1
        receiver.plane.refused.clear()
        reason = receiver.reason_against_height(passed, away[2], covariance[2, 2])
        if reason:
            receiver.height.refuse(fix.stamp, reason)
            if receiver.believes_height(passed):
                self._believe(in_map, receiver.height, passed, away * (0.0, 0.0, 1.0))
                return
            passed = without_height(passed)
            fix = passed.fix
        measured, variances = fix.there.copy(), receiver.weighted_variances(fix)
        if not fix.has_height:
            measured[2], variances[2] = antenna[2], _UNKNOWN_HEIGHT**2
        in_map.position(
            fix.stamp,
            measured,
            np.diag(variances),
            source=name,
            frame=receiver.frame,
            gate=receiver.noise.gate,
        )
        receiver.take(passed, covariance)

    def _believe(self, in_map: BaseEstimator, trust: FixTrust, passed: PassedFix, away: Floats) -> None:
        """Move the base in the map by ``away`` [m], (3,), to where fixes, or heights, agree that it is.

        It is placed at the newest stamp, so a position at the stamp of the fix would be of no effect.
        """
        newest = in_map.state()
        pose, known = newest.odom_from_base, newest.covariance.pose.copy()
        trust.restart()
        known[:3, :3] += trust.excess * np.diag(np.where(away == 0.0, 0.0, passed.fix.variances))
        place = pose.translation + away
        moved = Transform.from_pose7(
            self.map, self.odometry.base, (*place.tolist(), *pose.pose7[3:].tolist())
        )
        in_map.set_pose(moved.with_covariance(known))

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

    def _health(self, name: str, receiver: FixReceiver, newest: int) -> SourceHealth:
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


def _point_covariance(state: BaseState, lever: Floats) -> Floats:
    """That of the antenna in the world [m^2], (3, 3)."""
    jacobian = np.hstack((np.eye(3), -skew(state.odom_from_base.matrix[:3, :3] @ lever)))
    return jacobian @ state.covariance.pose @ jacobian.T


def _grown(kept: list[PassedFix], now: BaseState) -> Floats:
    """By how much the variances of the pose in odom have grown since the first of the fixes, (6,)."""
    return np.maximum(now.covariance.pose.diagonal() - kept[0].state.covariance.pose.diagonal(), 0.0)


def _is_apart(last: PassedFix, passed: PassedFix) -> bool:
    way = float(np.hypot(*(passed.here - last.here)[:2]))
    return way >= _ALIGNED_APART_M or passed.fix.stamp - last.fix.stamp >= _ALIGNED_APART_S * 1e9
