import math
import time

from zstate import connect
from zstate.driving import Commander

with connect() as session, Commander(session, "arm") as arm:
    arm.wait_for_driver()
    while True:
        arm.send({"elbow": 0.4 * math.sin(time.time())})  # [rad]
        time.sleep(0.02)
