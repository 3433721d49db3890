"""Coordinates: a name for each number of a robot's position vector."""

from __future__ import annotations

from zstate.model.robot import VELOCITY_COUNTS, Joint, RobotModel

_PARTS = {
    "floating": ("x", "y", "z", "qx", "qy", "qz", "qw"),
    "planar": ("x", "y", "yaw"),
}


def coordinate_names(model: RobotModel) -> tuple[str, ...]:
    """One name for each position: the joint's, or "base.x", "base.y" ... where a joint has several."""
    return tuple(name for joint in model.driven_joints for name in _names(joint))


def velocity_slots(model: RobotModel) -> tuple[int, ...]:
    """The coordinate under which each number of a velocity or effort vector stands.

    A floating joint has six velocities for seven positions: nothing stands under its last coordinate.
    """
    return tuple(
        model.columns[joint.name] + number
        for joint in model.driven_joints
        for number in range(VELOCITY_COUNTS[joint.type])
    )


def _names(joint: Joint) -> tuple[str, ...]:
    parts = _PARTS.get(joint.type)
    return (joint.name,) if parts is None else tuple(f"{joint.name}.{part}" for part in parts)
