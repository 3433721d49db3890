"""Lookup queryable: one lookup per Zenoh query, for devices without a buffer."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from zstate._util.fork_safe import fork_safe_lock
from zstate.buffer.buffer import TransformBuffer, feed_of
from zstate.buffer.tracks import JointTrack
from zstate.errors import AmbiguousFrame, ZStateError
from zstate.model.robot import RobotModel
from zstate.net.queryable import Queryable, Reply
from zstate.net.sample_history import SampleCache
from zstate.net.session import Session
from zstate.transform import Transform
from zstate.wire.keys import LOOKUP, full_name
from zstate.wire.lookup_request import LookupRequest, error_to_json, to_json
from zstate.wire.messages import from_block
from zstate.wire.native import decode_joint_state

_JSON = "application/json"


class LookupService(Queryable):
    """Answers ``zstate/<robot>/lookup?target=..;source=..;at=..`` with one transform in JSON.

    Without ``at`` [ns] the newest instant is used. Ambiguous bare frame names are those of ``robot``.
    ``buffer`` is the buffer, for instance ``listener.buffer``, or a function that returns it at each query.
    The reply to a failed lookup is an error, in JSON as well. A context manager.
    """

    def __init__(
        self, session: Session, buffer: TransformBuffer | Callable[[], TransformBuffer], robot: str
    ) -> None:
        def lookup(request: LookupRequest) -> Transform:
            current = buffer if isinstance(buffer, TransformBuffer) else buffer()
            try:
                return current.lookup(request.target, request.source, request.at)
            except AmbiguousFrame:
                target, source = (full_name(robot, name) for name in (request.target, request.source))
                return current.lookup(target, source, request.at)

        def answer(parameters: Mapping[str, str]) -> Reply:
            try:
                return Reply(to_json(lookup(LookupRequest.parse(parameters))), _JSON)
            except ZStateError as error:
                return Reply(error_to_json(error), _JSON, is_error=True)

        super().__init__(session, LOOKUP.key(robot), answer)


class RecentBuffer:
    """A buffer of one robot's frames, filled from its writer's sample cache at each query.

    Created at the first query, so that a publisher without queries pays nothing.
    """

    def __init__(self, model: RobotModel, robot: str, memory: SampleCache) -> None:
        self._model, self._robot = model, robot
        self._memory = memory
        self._state: tuple[TransformBuffer, JointTrack] | None = None
        self._next_seq = 0
        self._lock = fork_safe_lock()

    def buffer(self) -> TransformBuffer:
        """The buffer with every sample until now."""
        with self._lock:
            if self._state is None:
                made = TransformBuffer(self._memory.span_s)
                self._state = made, made.add_robot(self._model, self._robot)
            buffer, track = self._state
            for cached in self._memory.since(self._next_seq):
                state = decode_joint_state(cached.payload)
                rates = None if state.velocities is None else from_block(state.velocities)
                sample = (track, state.stamp, from_block(state.positions), rates)
                if not buffer.insert_joints(*sample):
                    # The writer's clock was set back: earlier samples are another epoch.
                    feed_of(buffer).restart(track)
                    buffer.insert_joints(*sample)
                self._next_seq = cached.seq + 1
        return buffer
