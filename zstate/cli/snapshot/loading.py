"""A Snapshot back onto the network: models and static edges for everybody, joints that stand still."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import ExitStack

from zstate.cli.output.console import count_text, fail, print_result, print_status
from zstate.cli.processes import BackgroundCall
from zstate.cli.snapshot.snapshot import RobotShot, Snapshot, StaticShot
from zstate.clock import SystemClock
from zstate.closing import Closing
from zstate.net.session import Session
from zstate.nodes.publisher import STREAMS, StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.rate import Rate


def chosen(snapshot: Snapshot, robots: Sequence[str]) -> tuple[list[RobotShot], list[StaticShot]]:
    """What the snapshot has of the named robots, or of all. Fails for one that it does not have."""
    known = {shot.name for shot in snapshot.robot} | {shot.robot for shot in snapshot.static}
    for name in robots:
        if name not in known:
            fail(f"the snapshot has no robot {name!r}; it has {', '.join(sorted(known)) or 'none'}")
    wanted = set(robots) or known
    return (
        [shot for shot in snapshot.robot if shot.name in wanted],
        [shot for shot in snapshot.static if shot.robot in wanted],
    )


class Standing(Closing):
    """Says what the shots have, and goes on saying it ``rate_hz`` times a second in ``run``."""

    def __init__(
        self,
        session: Session,
        robots: Sequence[RobotShot],
        statics: Sequence[StaticShot],
        wires: Sequence[str],
        *,
        takeover: bool,
    ) -> None:
        self._stop = threading.Event()
        self._standing: list[tuple[StatePublisher, RobotShot]] = []
        with ExitStack() as opening:
            for shot in robots:
                # A robot whose joints nobody knew is described, and says nothing of them now either.
                streams = STREAMS if shot.positions else ("robot_description", "tf_static")
                publisher = StatePublisher(
                    session, shot.model(), shot.name, wires, streams=streams, takeover=takeover
                )
                opening.enter_context(publisher)
                if shot.positions:
                    self._standing.append((publisher, shot))
                _tell(shot)
            for robot, writer in dict.fromkeys((shot.robot, shot.writer) for shot in statics):
                edges = [shot for shot in statics if (shot.robot, shot.writer) == (robot, writer)]
                placing = StaticPublisher(session, robot, writer, wires, takeover=takeover)
                opening.enter_context(placing)
                for shot in edges:
                    placing.set(shot.transform())
                print_result(f"{robot}: {count_text(len(edges), 'static edge')} of {writer}")
            self._opened = opening.pop_all()

    def close(self) -> None:
        self._stop.set()
        self._opened.close()

    def run(self, rate_hz: float, seconds: float | None) -> None:
        """Until ``seconds`` are over or a signal comes, which interrupts only the thread that waits."""
        worker = BackgroundCall("zstate snapshot", lambda: self._go_on(rate_hz, seconds))
        try:
            worker.result()
        except SystemExit:
            self._stop.set()
            worker.result(1.0)
            raise

    def _go_on(self, rate_hz: float, seconds: float | None) -> None:
        for now in Rate(rate_hz, SystemClock(), self._stop, seconds):
            for publisher, shot in self._standing:
                publisher.publish(shot.positions, stamp=now)


def _tell(shot: RobotShot) -> None:
    joints = count_text(len(shot.positions), "joint")
    state = f"{joints} standing still" if shot.positions else "no joint states"
    print_result(f"{shot.name}: its model, {state}; until Ctrl-C")
    if not shot.positions:
        print_status(
            f"{shot.name}: nothing was known of its joints when the snapshot was taken", robot=shot.name
        )
