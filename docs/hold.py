"""Hold a robot still: hold.py ROBOT JOINT=POSITION ..., the other joints at zero."""

import sys
import time

from zstate import StatePublisher, connect, load_model

name, *posture = sys.argv[1:]
model = load_model(name)
positions = dict.fromkeys(model.joint_names, 0.0)
for part in posture:
    joint, position = part.split("=")
    positions[joint] = float(position)
with connect() as session, StatePublisher(session, model, name) as robot:
    while True:
        robot.publish(positions)
        time.sleep(0.02)
