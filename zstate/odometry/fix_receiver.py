"""Which fixes of a GPS receiver are right, by the pose in the map, the way driven and each other.

- Errors of a fix wander: they are correlated over ``FixNoise.correlated_s``. A filter takes errors as
  independent, so the variance of each fix is multiplied by (1 + a) / (1 - a), a = exp(-dt / correlated_s)
  with dt the time since the last one. The mean of many is then as uncertain as it is.
- A fix is refused if it is further than the gate of its source, by default 99.9 %, from where the base is in
  the map; if it jumps from the last one, less the way driven, by more than a fix is uncertain; or if over
  half a minute the fixes leave the way by wheels and gyro, with the yaw in the map from before: a drift takes
  that with it. After a drift, all are refused.
- Fixes that are refused, but agree with each other and the way for ``correlated_s`` and 20 m, or for twice
  that time, are believed.
- The height of a fix has gates of its own: one that is refused leaves its position in use. It is believed as
  fixes are. A slow drift of the height is followed.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import numpy as np

from zstate.checks import Floats
from zstate.odometry.estimator import BaseState
from zstate.odometry.health import WINDOW, chi_square_quantile, gate
from zstate.odometry.map_alignment import turn
from zstate.odometry.source_noise import FixNoise

_MOST_KEPT = 1000
_KEPT_APART = 1.0 / 200.0
"""Fixes that are kept are apart by this part of the time over which they are compared."""
_WAY = 0.02
"""The error of a way by wheels is about this part of its length: ``VelocityNoise.scale``."""
_WANDER_S = (25.0, 40.0)
"""Over such a time, fixes that are honest do not leave the way by more than the gate."""
_UNPROVEN = 4.0
"""By how much the variance of fixes is larger than stated, before it was seen: stated are good conditions."""
_EXCESS_S, _MOST_EXCESS, _LEAST_EXCESS = 60.0, 25.0, 1.0
"""It is averaged for so long, and has these limits."""
_BELIEVED_WAY, _BELIEVED_COUNT, _BELIEVED_GATE = 20.0, 10, 0.95
"""The way of fixes that were refused [m], their least number, and how well they agree. By a wider gate, and
in less time, a drift of 0.5 m/s would agree with a way whose yaw is uncertain."""


class PlaneFix(NamedTuple):
    """A fix in the plane of the datum [m], (3,), with its variances [m^2], (3,)."""

    stamp: int
    there: Floats
    variances: Floats
    has_height: bool


class Turn(NamedTuple):
    """From odom to the map: the rotation in the plane, (2, 2), and the variance of its angle [rad^2]."""

    rotation: Floats
    variance: float


_UNKNOWN_TURN = Turn(np.eye(2), math.pi**2)


class PassedFix(NamedTuple):
    """A fix, and what was at its stamp.

    ``here`` is the antenna in odom [m], (3,), ``way`` the length of its path until then [m], ``state`` that
    of the odometry.
    """

    fix: PlaneFix
    here: Floats
    way: float
    state: BaseState
    map_from_odom: Turn


_Square: TypeAlias = Callable[[PassedFix, PassedFix], float]
"""By how much two fixes do not agree, but for the way, in units of their variances, squared."""


@dataclass(slots=True)
class FixTrust:
    """What is known of the errors of fixes in the plane, or of their heights."""

    excess: float = _UNPROVEN
    """By how much their variance is larger than stated."""
    refused: list[PassedFix] = field(default_factory=list[PassedFix])
    """Those since the last one that was fused that were not, and agree with each other."""
    refused_count: int = 0
    last_refusal: tuple[int, str] = (0, "")
    """When one was last refused, and why."""

    def refuse(self, stamp: int, reason: str) -> None:
        """Count one."""
        self.refused_count += 1
        self.last_refusal = (stamp, reason)

    def restart(self) -> None:
        """They were right after all: their errors are not proven again."""
        self.excess = max(self.excess, _UNPROVEN)
        self.refused.clear()

    def believes(self, passed: PassedFix, square: _Square, dimension: int, noise: FixNoise) -> bool:
        """Whether ``passed``, which is refused, and those before agree for so long that they are right."""
        run = self.refused
        if run and square(run[0], passed) > chi_square_quantile(_BELIEVED_GATE, dimension):
            run.clear()
        run.append(passed)
        del run[1 : 1 - _BELIEVED_COUNT]
        way = float(np.hypot(*(run[-1].here - run[0].here)[:2]))
        elapsed_s = (run[-1].fix.stamp - run[0].fix.stamp) * 1e-9
        least_s = noise.correlated_s if way >= _BELIEVED_WAY else 2.0 * noise.correlated_s
        return len(run) >= _BELIEVED_COUNT and elapsed_s >= least_s

    def learn(self, receiver: FixReceiver, passed: PassedFix, square: _Square, dimension: int) -> None:
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
class FixReceiver:
    """What is kept of one receiver, with its antenna at ``lever`` in the base [m], (3,)."""

    frame: str
    lever: Floats
    noise: FixNoise
    stamps: deque[int] = field(default_factory=lambda: deque[int](maxlen=WINDOW))
    """The stamps of the last fixes, in the order of arrival."""
    waiting: list[PlaneFix] = field(default_factory=list[PlaneFix])
    """Newer than the odometry, by stamp."""
    last: PassedFix | None = None
    """The last one of all."""
    aligning: list[PassedFix] = field(default_factory=list[PassedFix])
    """Those that align the map."""
    taken: deque[PassedFix] = field(default_factory=lambda: deque[PassedFix](maxlen=_MOST_KEPT))
    """The last ones that were fused."""
    plane: FixTrust = field(default_factory=FixTrust)
    height: FixTrust = field(default_factory=FixTrust)
    is_doubted: bool = False
    """They have left the way, as a drift does; then they are taken again once they are believed."""
    refused_jump: float = math.nan
    """A fix that jumps by more [m] than this, in any direction, would have been refused at the last one."""
    accepted_count: int = 0

    def begin(self) -> None:
        """Forget fixes of another time, as the odometry was restarted."""
        self.begin_way()
        self.waiting.clear()
        self.stamps.clear()
        for trust in (self.plane, self.height):
            trust.last_refusal = (0, "")
        self.is_doubted = False

    def begin_way(self) -> None:
        """Forget where fixes were in odom, as the odometry was moved there by hand."""
        for kept in (self.aligning, self.taken, self.plane.refused, self.height.refused):
            kept.clear()
        self.last = None

    def passed(self, fix: PlaneFix, odom: BaseState, in_map: BaseState | None) -> PassedFix:
        """A fix with the states at its stamp; that in the map is None while it has none."""
        pose = odom.odom_from_base
        here, last, turned = pose.translation + pose.matrix[:3, :3] @ self.lever, self.last, _UNKNOWN_TURN
        way = 0.0 if last is None else last.way + float(np.hypot(*(here - last.here)[:2]))
        if in_map is not None:
            yaw = in_map.odom_from_base.rpy[2] - pose.rpy[2]
            turned = Turn(turn(yaw), float(in_map.covariance.pose[5, 5]))
        self.last = PassedFix(fix, here, way, odom, turned)
        return self.last

    def is_known(self, fix: PlaneFix) -> bool:
        """Whether it is the same fix again, as after a reconnection."""
        same = (one.fix.stamp for one in reversed(self.taken) if one.fix.stamp <= fix.stamp)
        return next(same, None) == fix.stamp

    def reason_against(self, passed: PassedFix, away: Floats, covariance: Floats) -> str:
        """Why a fix is refused; empty if it is not.

        It is ``away`` [m] from where the antenna is with ``covariance``; of both the plane counts.
        """
        reason = self._contradiction(passed, away, covariance)
        if not reason:
            reason = self._drift(passed)
            self.is_doubted = self.is_doubted or bool(reason)
        if not reason and self.is_doubted:
            reason = "not along the way by wheels and gyro for long enough, since they have left it"
        return reason

    def _contradiction(self, passed: PassedFix, away: Floats, covariance: Floats) -> str:
        """By what a fix contradicts the pose in the map, or the fix before; empty if it does not."""
        most, excess = gate(2, self.noise.gate), self.plane.excess
        if _mahalanobis(away[:2], covariance[:2, :2] + excess * np.diag(passed.fix.variances[:2])) > most:
            return f"{np.hypot(*away[:2]):.1f} m from where wheels, gyro and earlier fixes lead"
        if self.taken:
            last = self.taken[-1]
            if _square(last, passed, excess) > self._share(last, passed) * most:
                jump, _ = _difference(last, passed)
                return f"{np.hypot(*jump):.1f} m from the one before, but for the way by wheels and gyro"
        return ""

    def _drift(self, passed: PassedFix) -> str:
        """By how much fixes have left the way in half a minute; empty if no more than honest ones do."""
        for earlier in self.taken:
            elapsed_s = (passed.fix.stamp - earlier.fix.stamp) * 1e-9
            if _WANDER_S[0] <= elapsed_s <= _WANDER_S[1]:
                wander, covariance = _difference(earlier, passed, _UNPROVEN)
                if _mahalanobis(wander, covariance) > gate(2, self.noise.gate):
                    off = np.hypot(*wander)
                    return f"{off:.1f} m off the way by wheels and gyro since one {elapsed_s:.0f} s before"
                break
        return ""

    def reason_against_height(self, passed: PassedFix, away: float, variance: float) -> str:
        """Why the height of a fix is refused; empty if it is not, or if it has none."""
        if not passed.fix.has_height:
            return ""
        most, excess = gate(1, self.noise.gate), self.height.excess
        if away**2 > most * (variance + excess * passed.fix.variances[2]):
            return f"{abs(away):.1f} m from where earlier ones and the odometry lead"
        last = next((one for one in reversed(self.taken) if one.fix.has_height), None)
        if last is not None and _square_of_heights(last, passed, excess) > self._share(last, passed) * most:
            return f"{abs(_rise(last, passed)):.1f} m from the one before, but for the way by the odometry"
        return ""

    def _share(self, last: PassedFix, passed: PassedFix) -> float:
        """The part of the variance of a difference: errors of neighbours are alike."""
        elapsed_s = (passed.fix.stamp - last.fix.stamp) * 1e-9
        return 0.5 if elapsed_s < self.noise.correlated_s else 1.0

    def believes(self, passed: PassedFix) -> bool:
        """Whether ``passed``, which is refused, is right after all, with those before."""
        if not self.plane.believes(passed, _square, 2, self.noise):
            return False
        self.accepted_count += 1
        self.is_doubted = False
        self.taken.clear()  # the jump from earlier ones is no error of those to come
        self.taken.append(passed)
        return True

    def believes_height(self, passed: PassedFix) -> bool:
        """The same of its height."""
        if not self.height.believes(passed, _square_of_heights, 1, self.noise):
            return False
        self.taken = deque((without_height(one) for one in self.taken), _MOST_KEPT)
        self.taken.append(passed)
        return True

    def weighted_variances(self, fix: PlaneFix) -> Floats:
        """Those of a fix [m^2], (3,), for a filter that takes errors as independent."""
        trusted = np.array((self.plane.excess, self.plane.excess, self.height.excess)) * fix.variances
        if not self.taken:
            return trusted
        elapsed_s = abs(fix.stamp - self.taken[-1].fix.stamp) * 1e-9
        kept = math.exp(-elapsed_s / self.noise.correlated_s)
        return (1.0 + kept) / (1.0 - kept) * trusted

    def take(self, passed: PassedFix, covariance: Floats) -> None:
        """Keep a fix that was fused where the antenna is with ``covariance``, and learn from it."""
        self.refused_jump = self._refused_jump(passed, covariance)
        taken, fix = self.taken, passed.fix
        if taken and fix.stamp < taken[-1].fix.stamp:
            return  # later ones are compared with the last one
        self.plane.learn(self, passed, _square, 2)
        if fix.has_height:
            self.height.refused.clear()
            self.height.learn(self, passed, _square_of_heights, 1)
        apart_ns = _KEPT_APART * 1e9 * max(_WANDER_S[1], self.noise.correlated_s)
        if len(taken) > 1 and taken[-1].fix.stamp - taken[-2].fix.stamp < apart_ns:
            taken.pop()
        taken.append(passed)

    def _refused_jump(self, passed: PassedFix, covariance: Floats) -> float:
        """From which distance [m] on a fix in place of this one contradicts, whatever its direction."""
        excess = self.plane.excess
        in_place = covariance[:2, :2] + excess * np.diag(passed.fix.variances[:2])
        squares = [float(np.linalg.eigvalsh(in_place)[-1])]
        if self.taken:
            last = self.taken[-1]
            _, between = _difference(last, passed, excess)
            squares.append(self._share(last, passed) * float(np.linalg.eigvalsh(between)[-1]))
        return math.sqrt(gate(2, self.noise.gate) * min(squares))


def without_height(passed: PassedFix) -> PassedFix:
    """``passed`` with the position alone."""
    return passed._replace(fix=passed.fix._replace(has_height=False))


def _difference(first: PassedFix, second: PassedFix, excess: float = 1.0) -> tuple[Floats, Floats]:
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


def _square(first: PassedFix, second: PassedFix, excess: float = 1.0) -> float:
    """The square of ``_difference`` in units of its covariance."""
    return _mahalanobis(*_difference(first, second, excess))


def _rise(first: PassedFix, second: PassedFix) -> float:
    """By how much the difference of two heights is not that by the odometry [m]."""
    return float((second.fix.there - first.fix.there)[2] - (second.here - first.here)[2])


def _square_of_heights(first: PassedFix, second: PassedFix, excess: float = 1.0) -> float:
    """The square of ``_rise`` in units of its variance."""
    variance = excess * (first.fix.variances[2] + second.fix.variances[2])
    return _rise(first, second) ** 2 / (variance + (_WAY * (second.way - first.way)) ** 2)
