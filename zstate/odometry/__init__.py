"""Odometry: where a robot's base is, from an IMU, wheels, legs and poses, with a covariance."""

from zstate.odometry.listener import SensorListener
from zstate.odometry.map_correction import MapCorrection
from zstate.odometry.publishers import ImuPublisher, OdometryPublisher, VelocityPublisher

__all__ = ["ImuPublisher", "MapCorrection", "OdometryPublisher", "SensorListener", "VelocityPublisher"]
