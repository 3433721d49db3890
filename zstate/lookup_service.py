"""LookupService: lookups by one query, for devices that have no buffer."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.tracks import JointTrack
from zstate.closing import Closing
from zstate.errors import AmbiguousFrame, ZStateError
from zstate.locks import new_lock
from zstate.model.robot import RobotModel
from zstate.net.history import Memory
from zstate.net.service import Answer, Service
from zstate.net.session import Session
from zstate.transform import Transform
from zstate.wire.json import to_json
from zstate.wire.keys import full_name, lookup_key
from zstate.wire.messages import from_block
from zstate.wire.questions import LookupQuestion, error_to_json

_JSON = "application/json"


class LookupService(Closing):
    """Answers ``zstate/<robot>/lookup?target=..;source=..;at=..`` with one transform in JSON.

    ``at`` [ns] may be left out for the newest instant. Bare frame names that several robots have are
    those of ``robot``. ``buffer`` is what answers, for instance ``listener.buffer``, or what gives it when
    it is called for. A question that has no answer is answered with an error, in JSON as well. A context
    manager.
    """

    def __init__(
        self, session: Session, buffer: TransformBuffer | Callable[[], TransformBuffer], robot: str
    ) -> None:
        self._take_buffer = (lambda: buffer) if isinstance(buffer, TransformBuffer) else buffer
        self._robot = robot
        self._service = Service(session, lookup_key(robot), self._answer)

    @property
    def answered(self) -> int:
        """How many questions were answered, refusals included."""
        return self._service.answered

    @property
    def overflows(self) -> int:
        """How often so many questions waited that some may have been lost."""
        return self._service.overflows

    def _answer(self, parameters: Mapping[str, str]) -> Answer:
        try:
            return Answer(to_json(self._look_up(LookupQuestion.parse(parameters))), _JSON)
        except ZStateError as error:
            return Answer(error_to_json(error), _JSON, is_error=True)

    def _look_up(self, asked: LookupQuestion) -> Transform:
        buffer = self._take_buffer()
        try:
            return buffer.lookup(asked.target, asked.source, asked.at)
        except AmbiguousFrame:
            names = [full_name(self._robot, frame) for frame in (asked.target, asked.source)]
            return buffer.lookup(names[0], names[1], asked.at)

    def close(self) -> None:
        """Answer no more. A second call does nothing."""
        self._service.close()


class RecentBuffer:
    """A buffer of one robot's frames, filled from its writer's memory at each query.

    It is made at the first query; a publisher that is never asked pays nothing.
    """

    def __init__(self, model: RobotModel, robot: str, memory: Memory) -> None:
        self._model, self._robot = model, robot
        self._memory = memory
        self._made: tuple[TransformBuffer, JointTrack] | None = None
        self._next_seq = 0
        self._lock = new_lock()

    def filled(self) -> TransformBuffer:
        """The buffer, with every sample until now."""
        with self._lock:
            if self._made is None:
                made = TransformBuffer(self._memory.span_s)
                self._made = made, made.add_robot(self._model, self._robot)
            buffer, track = self._made
            for state in self._memory.since(self._next_seq):
                rates = None if state.velocities is None else from_block(state.velocities)
                sample = (track, state.stamp, from_block(state.positions), rates)
                if not buffer.insert_joints(*sample):
                    # The writer's clock was set back: what it said before is another epoch.
                    buffer.restart(track)
                    buffer.insert_joints(*sample)
                self._next_seq = state.seq + 1
        return buffer
