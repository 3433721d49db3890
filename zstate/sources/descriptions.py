"""Robot models from descriptions on the network."""

from __future__ import annotations

from collections.abc import Callable

from zstate._util.refusals import Refusals
from zstate.closing import Closing
from zstate.errors import ModelError
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.net.wires import wire_named
from zstate.wire.messages import RobotDescription


class Descriptions(Closing):
    """Subscribes to the ``robot_description`` of ``robot`` ("*": of all robots), earlier ones included.

    ``on_description(robot, model)`` is called from one thread with the first model of a robot, and
    with each one that replaces it. Descriptions that cannot be used are counted in ``refused``, by
    reason; the first of each is also logged.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        on_description: Callable[[str, RobotModel], object],
        wire: str = "native",
    ) -> None:
        self._refusals = Refusals("robot_description")
        self.refused = self._refusals.counts
        self._on_description = on_description
        self._urdfs: dict[str, str] = {}
        self._subscriber = subscribe(
            session,
            wire_named(wire),
            robot,
            "robot_description",
            self._on_messages,
            on_error=self._refusals.count,
        )

    def _on_messages(self, received: list[Received]) -> None:
        for robot, _, description in received:
            assert isinstance(description, RobotDescription)
            if description.urdf == self._urdfs.get(robot):
                continue
            try:
                # Plain URDF text: input from the network opens no files and runs no xacro.
                model = parse_urdf(description.urdf, f"the URDF of {robot!r}")
            except ModelError as error:
                self._refusals.count("model", error)
                continue
            self._urdfs[robot] = description.urdf
            self._on_description(robot, model)

    def close(self) -> None:
        """Stop listening within a second. A second call does nothing."""
        self._subscriber.close()
