"""How far an interpolated pose can be from the true one, by the velocity limits of the joints.

Between two samples, at q_a and q_b, a joint that keeps its velocity limit v stays at each instant within
v t_a of q_a and within v t_b of q_b, where t_a and t_b are the times to both samples. Its error e is at most
the distance from the interpolated position to the farther end of that interval. The pose is changed to the
true one joint by joint: a revolute joint turns what is beyond it by e, which moves the frame by no more than
e times the length of the path, and a prismatic joint moves it by e.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

from zstate.buffer.frame_tree import Edge
from zstate.buffer.interpolation import Bracket, PoseInterpolator, bracket_at
from zstate.buffer.path import joint_interpolators
from zstate.buffer.tracks import JointTrack


class InterpolationBound(NamedTuple):
    """How far a pose can be from the true one: ``translation`` [m] and ``rotation`` [rad].

    Zero at samples, and infinite if no bound is known: of edges without a model, of floating and planar
    joints, and of joints without a velocity limit. ``gap_s`` is the longest interval between two samples
    that the pose is interpolated in [s].
    """

    gap_s: float
    translation: float
    rotation: float


def interpolation_bound(edges: Iterable[Edge], at: int) -> InterpolationBound:
    """The bound of the pose over ``edges`` at ``at`` [ns], which all of them cover."""
    gap_s = length = shift = turn = 0.0
    for edge in edges:
        track = edge.track
        if track is None:
            length += math.hypot(*edge.pose[:3])
            continue
        now = bracket_at(track.history.view, at)
        seconds = math.inf if now is None else float(now.seconds)
        gap_s = max(gap_s, seconds)
        form = track.forms[edge.index] if isinstance(track, JointTrack) else None
        if now is None or not isinstance(track, JointTrack) or form is None:
            shift, turn = (shift, turn) if seconds == 0.0 else (math.inf, math.inf)
            continue
        error = abs(form.scale) * _joint_error(track, edge.index, now) if seconds else 0.0
        length += math.hypot(*form.t0)
        if form.kind == "revolute":
            turn += error
        elif form.kind == "prismatic":
            shift += error
            position = float(now.a[form.column] + now.ratio * (now.b[form.column] - now.a[form.column]))
            length += abs(form.scale * position + form.shift) + error
        elif seconds:
            shift = turn = math.inf
    return InterpolationBound(gap_s, shift + (length * turn if length and turn else 0.0), min(turn, math.pi))


def _joint_error(track: JointTrack, index: int, now: Bracket) -> float:
    """How far the driven joint that moves an edge can be from its interpolated position."""
    model = track.model
    name = model.mimic_of(model.joints[index]).joint
    limit = next(joint.limits.velocity for joint in model.joints if joint.name == name)
    one = joint_interpolators(track, index)[0]
    if math.isinf(limit) or isinstance(one, PoseInterpolator):
        return math.inf
    change, ratio = float(one.difference(now)), float(now.ratio)
    reach = limit * float(now.seconds)
    if track.is_continuous(index) and reach >= math.pi:
        return math.pi  # it may have turned the other way
    if abs(change) > reach:
        return math.inf  # it does not keep its limit
    # From the interpolated position to the end of both cones, upwards and downwards.
    up = min(reach * ratio - change * ratio, reach * (1.0 - ratio) + change * (1.0 - ratio))
    down = min(reach * ratio + change * ratio, reach * (1.0 - ratio) - change * (1.0 - ratio))
    return max(up, down)
