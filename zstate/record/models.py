"""The models that a recording describes, as far as its joint states fit them."""

from __future__ import annotations

from collections.abc import Callable, Collection
from itertools import islice

from zstate.errors import MessageError, ModelError
from zstate.model.coordinates import coordinate_names, velocity_slots
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.record.transcript import Said, Transcript
from zstate.wire.joint_order import JointOrder
from zstate.wire.messages import JointState, RobotDescription

_TRIED = 100
"""So many joint states are looked at for one that tells all joints of the model."""


def joint_order(model: RobotModel) -> JointOrder:
    """What reads the joint states of a robot with this model."""
    return JointOrder(model.joint_names, coordinate_names(model), velocity_slots(model))


def first_descriptions(transcript: Transcript, robots: Collection[str] | None = None) -> dict[str, Said]:
    """The first description of each robot, as it was said."""
    described = [s.robot for s in transcript.speakers if s.stream == "robot_description"]
    missing = {robot for robot in described if robots is None or robot in robots}
    found: dict[str, Said] = {}
    for said in transcript.said(missing, ("robot_description",)):
        found.setdefault(said.speaker.robot, said)
        if found.keys() == missing:
            break
    return found


def model_of(
    transcript: Transcript, description: Said, refuse: Callable[[str, str], None]
) -> RobotModel | None:
    """The model of a described robot, None where its joint states are of no use.

    That is where there are none, where the URDF cannot be understood, and where none of the first joint
    states tells all of its joints: in a bag of ROS they may come in parts, from several topics.
    """
    robot, message = description.speaker.robot, description.message
    assert isinstance(message, RobotDescription)
    try:
        # Text and nothing else: what a file says opens no other files and runs no xacro.
        model = parse_urdf(message.urdf, f"the URDF of {robot!r}")
    except ModelError as error:
        refuse("robot description", f"{robot!r}: {error}")
        return None
    return model if _is_told(transcript, robot, model) else None


def _is_told(transcript: Transcript, robot: str, model: RobotModel) -> bool:
    order = joint_order(model)
    for said in islice(transcript.said((robot,), ("joint_states",)), _TRIED):
        assert isinstance(said.message, JointState)
        try:
            order.read(said.message)
        except MessageError:
            continue
        return True
    return False
