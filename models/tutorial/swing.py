import math
import time

from zstate import StatePublisher, connect, load_model

model = load_model("arm.urdf")
with connect() as session, StatePublisher(session, model, streams=("joint_states",)) as arm:
    while True:
        angle = 1.2 * math.sin(time.time())
        arm.publish({"shoulder": angle, "elbow": -angle})
        time.sleep(0.02)
