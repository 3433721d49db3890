"""The models of robots, as somebody else describes them."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable

from zstate.closing import Closing
from zstate.errors import InvalidInput, MessageError, ModelError, ZStateError
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.net.latched import LatchedSubscriber
from zstate.net.session import Session
from zstate.net.wires import wire_named
from zstate.wire.keys import ANY
from zstate.wire.messages import RobotDescription
from zstate.wire.protocol import SerializedSample

_LOG = logging.getLogger("zstate")


class Descriptions(Closing):
    """Hears the ``robot_description`` of ``robot`` ("*": of all robots), also one that was said before.

    ``on_description(robot, model)`` is called from one thread with the first model of a robot, and
    whenever another one replaces it. Descriptions that cannot be used are counted in ``refused``, by
    reason; the first of each is also logged.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        on_description: Callable[[str, RobotModel], object],
        wire: str = "native",
    ) -> None:
        self.refused: Counter[str] = Counter()
        self._robot = robot
        self._on_description = on_description
        self._wire = wire_named(wire)
        self._said: dict[str, str] = {}
        key = self._wire.expression(robot, "robot_description")
        self._subscriber = LatchedSubscriber(session, key, self._take)

    def _take(self, arrival: SerializedSample) -> None:
        if not arrival.payload:
            return
        try:
            robot = self._wire.robot_of(arrival.key) if self._robot == ANY else self._robot
            (said,) = self._wire.decode("robot_description", arrival, robot)
            assert isinstance(said, RobotDescription)
            if said.urdf == self._said.get(robot):
                return
            # Text and nothing else: what comes over the network opens no files and runs no xacro.
            model = parse_urdf(said.urdf, f"the URDF of {robot!r}")
        except (MessageError, ModelError) as error:
            self._refuse(error.reason if isinstance(error, MessageError) else "model", error)
            return
        except InvalidInput as error:
            self._refuse("foreign", error)
            return
        self._said[robot] = said.urdf
        self._on_description(robot, model)

    def _refuse(self, reason: str, error: ZStateError) -> None:
        self.refused[reason] += 1
        if self.refused[reason] == 1:
            _LOG.warning("robot_description refused (%s): %s; further ones are only counted", reason, error)

    def close(self) -> None:
        """Stop listening within a second. A second call does nothing."""
        self._subscriber.close()
