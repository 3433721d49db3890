"""The process of one buffer of ``lookup``: ``PYTHON -m bench.micro.lookup_buffers NAME MOTION``.

It fills the buffer and then serves requests: the case, and the stamps. A buffer is a function of the motion,
which returns what fills it, and its cases; each takes stamps and returns a callable and its arguments. Only
the standard library is imported at module level: tf2 runs in Debian's Python.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

from bench.motion_file import MotionFile

CHUNK = 50
FUTURE_NS = 10**12

Cases: TypeAlias = "dict[str, Callable[[list[int]], tuple[Callable[[Any], object], Sequence[Any]]]]"


def zstate(motion: MotionFile) -> tuple[Callable[[], None], Cases]:
    """zstate's buffer, filled with joint positions."""
    import numpy as np  # noqa: PLC0415 - each process imports one library

    from zstate import LookupFailed, TransformBuffer, load_model  # noqa: PLC0415 - as above

    facts = motion.facts
    target, source, count, step = facts["target"], facts["source"], facts["count"], facts["step"]
    model = load_model(motion.path.with_suffix(".urdf").read_text())
    TransformBuffer().add_robot(model)  # modules loaded by this call do not count as memory of the buffer
    rows = list(np.fromfile(motion.path.with_suffix(".positions")).reshape(count, -1))
    buffer = TransformBuffer(count * step * 1e-9)
    lookup = buffer.lookup
    track, stamps = buffer.add_robot(model), iter(range(facts["first"], 2**63, step))

    def insert(row: Any) -> None:
        buffer.insert_joints(track, next(stamps), row)

    def fill() -> None:
        for row in rows:
            insert(row)
        plan = buffer.plan(target, source)
        cases["plan"] = lambda asked: ((lambda stamp: plan.at(stamp)), asked)  # noqa: PLW0108 - called as the other cases
        cases["batch"] = lambda asked: (plan.poses, [np.array(asked[:1000])] * 10)

    def future(stamp: int) -> object:
        try:
            return lookup(target, source, stamp + FUTURE_NS)
        except LookupFailed as reason:
            return reason

    cases: Cases = {
        "name": lambda asked: ((lambda stamp: lookup(target, source, stamp)), asked),
        "future": lambda asked: (future, asked),
        "insert": lambda asked: (insert, rows[: len(asked)]),
    }
    return fill, cases


def transform_tree(motion: MotionFile) -> tuple[Callable[[], None], Cases]:
    """transform-tree, with tf2's rule of interpolation; poses are requested as seven numbers, its fastest."""
    import numpy as np  # noqa: PLC0415 - as above
    import tf_tree  # noqa: PLC0415 - as above

    facts = motion.facts
    target, source, count = facts["target"], facts["source"], facts["count"]
    order = [6, 3, 4, 5, 0, 1, 2]
    topology = '[topology]\ninterp = "lerpslerp"\n'
    for parent, child, pose in motion.statics:
        numbers = ", ".join(repr(float(pose[k])) for k in order)
        topology += f'[[edge]]\nparent = "{parent}"\nchild = "{child}"\nkind = "static"\npose = [{numbers}]\n'
    for parent, child in motion.edges:
        topology += (
            f'[[edge]]\nparent = "{parent}"\nchild = "{child}"\nkind = "dynamic"\ncapacity = {count}\n'
        )
    poses = np.fromfile(motion.path.with_suffix(".poses")).reshape(count, -1, 7)
    samples = [list(sample) for sample in np.ascontiguousarray(poses[..., order])]
    tree = tf_tree.build(topology)
    lookup = tree.lookup
    publishers = [tree.publisher(child, parent) for parent, child in motion.edges]
    stamps = iter(range(facts["first"], 2**63, facts["step"]))

    def insert(sample: list[Any]) -> None:
        stamp = next(stamps)
        for publisher, pose in zip(publishers, sample, strict=True):
            publisher.push(stamp, pose)

    def fill() -> None:
        for sample in samples:
            insert(sample)
        at = tree.plan(target, source).at
        cases["plan"] = lambda asked: ((lambda stamp: at(stamp, layout="quat")), asked)
        cases["batch"] = lambda asked: ((lambda row: at(row, layout="quat")), [np.array(asked[:1000])] * 10)

    def future(stamp: int) -> object:
        try:
            return lookup(target, source, stamp + FUTURE_NS)
        except tf_tree.TfTreeError as reason:
            return reason

    cases: Cases = {
        "name": lambda asked: ((lambda stamp: lookup(target, source, stamp)), asked),
        "future": lambda asked: (future, asked),
        "insert": lambda asked: (insert, samples[: len(asked)]),
    }
    return fill, cases


def tf2(motion: MotionFile) -> tuple[Callable[[], None], Cases]:
    """tf2 from Debian; stamps are converted to ROS times beforehand and not counted."""
    import rospy  # noqa: PLC0415 - as above
    import tf2_ros  # noqa: PLC0415 - as above
    from geometry_msgs.msg import TransformStamped  # noqa: PLC0415 - as above

    facts = motion.facts
    target, source, count, step = facts["target"], facts["source"], facts["count"], facts["step"]
    buffer = tf2_ros.Buffer(rospy.Duration(count * step * 1e-9), debug=False)
    lookup, core = buffer.lookup_transform, buffer.lookup_transform_core
    rows, stamps = motion.rows(), iter(range(facts["first"], 2**63, step))

    def time_of(stamp: int) -> Any:
        return rospy.Time(*divmod(stamp, 10**9))

    def message(parent: str, child: str, stamp: int, pose: Sequence[float]) -> Any:
        one = TransformStamped()
        one.header.frame_id, one.header.stamp, one.child_frame_id = parent, time_of(stamp), child
        position, rotation = one.transform.translation, one.transform.rotation
        position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w = pose
        return one

    def sample(row: Sequence[float]) -> list[Any]:
        stamp = next(stamps)
        return [message(*edge, stamp, row[7 * n : 7 * n + 7]) for n, edge in enumerate(motion.edges)]

    def insert(transforms: list[Any]) -> None:
        for one in transforms:
            buffer.set_transform(one, "bench")

    def fill() -> None:
        for parent, child, pose in motion.statics:
            buffer.set_transform_static(message(parent, child, facts["first"], pose), "bench")
        for row in rows:
            insert(sample(row))

    def future(time: Any) -> object:
        try:
            return lookup(target, source, time)
        except tf2_ros.TransformException as reason:
            return reason

    return fill, {
        "name": lambda asked: ((lambda at: lookup(target, source, at)), list(map(time_of, asked))),
        "plan": lambda asked: (
            (lambda at: core(target, source, at)),
            list(map(time_of, asked)),
        ),
        "future": lambda asked: (future, [time_of(stamp + FUTURE_NS) for stamp in asked]),
        "insert": lambda asked: (insert, [sample(rows[n % count]) for n in range(len(asked))]),
    }


def resident_mb() -> float:
    """Resident memory of this process [MB]."""
    with open("/proc/self/status") as status:  # noqa: PTH123 - as short as it gets
        return next(int(line.split()[1]) for line in status if line.startswith("VmRSS")) / 1e3


def call_times_us(call: Callable[[Any], object], arguments: Sequence[Any]) -> list[float]:
    """Thread CPU time per call [us], as means over chunks: one call is shorter than reading the clock."""
    times: list[float] = []
    for start in range(0, len(arguments), CHUNK):
        chunk = arguments[start : start + CHUNK]
        before = time.thread_time_ns()
        for argument in chunk:
            call(argument)
        times.append((time.thread_time_ns() - before) * 1e-3 / len(chunk))
    return times


def main() -> None:
    """Fills the buffer, and serves requests until the input ends."""
    name, path = sys.argv[1:]
    fill, cases = {"zstate": zstate, "transform-tree": transform_tree, "tf2": tf2}[name](MotionFile(path))
    before_mb = resident_mb()
    fill()
    print(json.dumps({"event": "filled", "memory_mb": resident_mb() - before_mb}), flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        case = cases.get(request["case"])
        times = call_times_us(*case(request["stamps"])) if case else []
        print(json.dumps({"event": "times", "times": times}), flush=True)


if __name__ == "__main__":
    main()
