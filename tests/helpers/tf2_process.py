"""Runs the real tf2 under the system's Python: one JSON line per scenario in, one per list of results out.

Only the standard library and tf2_py are imported here.
"""

import json
import sys
import warnings
from types import SimpleNamespace

import tf2_py

NS = 1_000_000_000


class Seconds:
    """A time or duration as tf2_py accepts it."""

    def __init__(self, nanoseconds):
        self.nanoseconds = nanoseconds

    def to_sec(self):
        return self.nanoseconds / NS


def message(parent, child, stamp, pose):
    x, y, z, qx, qy, qz, qw = pose
    return SimpleNamespace(
        header=SimpleNamespace(frame_id=parent, stamp=Seconds(stamp)),
        child_frame_id=child,
        transform=SimpleNamespace(
            translation=SimpleNamespace(x=x, y=y, z=z), rotation=SimpleNamespace(x=qx, y=qy, z=qz, w=qw)
        ),
    )


def plain(answer):
    t, q, stamp = answer.transform.translation, answer.transform.rotation, answer.header.stamp
    return {"pose": [t.x, t.y, t.z, q.x, q.y, q.z, q.w], "stamp": stamp.secs * NS + stamp.nsecs}


def lookup(core, query):
    try:
        if len(query) == 3:
            target, source, stamp = query
            return plain(core.lookup_transform_core(target, source, Seconds(stamp or 0)))
        target, target_at, source, source_at, fixed = query
        times = Seconds(target_at or 0), Seconds(source_at or 0)
        return plain(core.lookup_transform_full_core(target, times[0], source, times[1], fixed))
    except tf2_py.TransformException as error:
        return {"error": type(error).__name__}


def run(scenario):
    core = tf2_py.BufferCore(Seconds(scenario["history"]))
    answers = []
    for name, *values in scenario["steps"]:
        if name == "insert":
            core.set_transform(message(*values), "test")
        elif name == "static":
            core.set_transform_static(message(values[0], values[1], 0, values[2]), "test")
        elif name == "clear":
            core.clear()
        else:
            answers.append(lookup(core, values))
    return answers


warnings.simplefilter("ignore")
for line in sys.stdin:
    print(json.dumps(run(json.loads(line))), flush=True)
