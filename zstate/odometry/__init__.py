"""Odometry: where a robot's base is, from an IMU, wheels, legs and poses, with a covariance."""

from zstate.odometry.estimator import BaseCovariance, BaseEstimator, BaseState, BaseTwist
from zstate.odometry.health import SourceHealth
from zstate.odometry.invariant_filter import ImuNoise
from zstate.odometry.legs import ForceThresholds, LegNoise, Legs, SpeedThresholds
from zstate.odometry.map_correction import MapCorrection
from zstate.odometry.node import OdometryNode, SensorListener
from zstate.odometry.publishers import ImuPublisher, OdometryPublisher, PosePublisher, VelocityPublisher
from zstate.odometry.requests import request_odometry
from zstate.odometry.simulated_rover import SimulatedRover, SimulatedWheels
from zstate.odometry.source_noise import PoseNoise, VelocityNoise
from zstate.odometry.wheels import Ackermann, DiffDrive, Mecanum, WheelNoise, Wheels, WheelVelocity

__all__ = [
    "Ackermann",
    "BaseCovariance",
    "BaseEstimator",
    "BaseState",
    "BaseTwist",
    "DiffDrive",
    "ForceThresholds",
    "ImuNoise",
    "ImuPublisher",
    "LegNoise",
    "Legs",
    "MapCorrection",
    "Mecanum",
    "OdometryNode",
    "OdometryPublisher",
    "PoseNoise",
    "PosePublisher",
    "SensorListener",
    "SimulatedRover",
    "SimulatedWheels",
    "SourceHealth",
    "SpeedThresholds",
    "VelocityNoise",
    "VelocityPublisher",
    "WheelNoise",
    "WheelVelocity",
    "Wheels",
    "request_odometry",
]
