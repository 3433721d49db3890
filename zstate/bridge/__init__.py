"""Whole robots, carried between the native wire and a ROS wire."""

from zstate.bridge.bridge import Bridge
from zstate.bridge.carrier import Carrier, Side, Way

__all__ = ["Bridge", "Carrier", "Side", "Way"]
