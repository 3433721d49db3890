"""Odometry: where a robot's base is, from an IMU, wheels, legs and poses, with a covariance."""

from typing import TYPE_CHECKING

from zstate._util.lazy_names import lazy_names

if TYPE_CHECKING:
    from zstate.odometry.estimator import BaseCovariance, BaseEstimator, BaseState, BaseTwist
    from zstate.odometry.geodesy import Datum
    from zstate.odometry.health import SourceHealth
    from zstate.odometry.invariant_filter import ImuNoise
    from zstate.odometry.legs import ForceThresholds, LegNoise, Legs, SpeedThresholds
    from zstate.odometry.magnetism import earth_field
    from zstate.odometry.map_correction import MapCorrection
    from zstate.odometry.map_estimator import MapEstimator, MapState
    from zstate.odometry.node import OdometryNode, SensorListener
    from zstate.odometry.publishers import (
        DatumPublisher,
        FixPublisher,
        ImuPublisher,
        MagneticFieldPublisher,
        OdometryPublisher,
        PosePublisher,
        PressurePublisher,
        VelocityPublisher,
    )
    from zstate.odometry.requests import request_odometry
    from zstate.odometry.simulated_rover import SimulatedRover, SimulatedWheels
    from zstate.odometry.source_noise import (
        BarometerNoise,
        FixNoise,
        HeadingNoise,
        MagnetometerNoise,
        PoseNoise,
        RelativeNoise,
        VelocityNoise,
    )
    from zstate.odometry.wheels import Ackermann, DiffDrive, Mecanum, WheelNoise, Wheels, WheelVelocity

__all__ = [
    "Ackermann",
    "BarometerNoise",
    "BaseCovariance",
    "BaseEstimator",
    "BaseState",
    "BaseTwist",
    "Datum",
    "DatumPublisher",
    "DiffDrive",
    "FixNoise",
    "FixPublisher",
    "ForceThresholds",
    "HeadingNoise",
    "ImuNoise",
    "ImuPublisher",
    "LegNoise",
    "Legs",
    "MagneticFieldPublisher",
    "MagnetometerNoise",
    "MapCorrection",
    "MapEstimator",
    "MapState",
    "Mecanum",
    "OdometryNode",
    "OdometryPublisher",
    "PoseNoise",
    "PosePublisher",
    "PressurePublisher",
    "RelativeNoise",
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
    "earth_field",
    "request_odometry",
]

_HOMES = {
    "Ackermann": "wheels",
    "BarometerNoise": "source_noise",
    "BaseCovariance": "estimator",
    "BaseEstimator": "estimator",
    "BaseState": "estimator",
    "BaseTwist": "estimator",
    "Datum": "geodesy",
    "DatumPublisher": "publishers",
    "DiffDrive": "wheels",
    "FixNoise": "source_noise",
    "FixPublisher": "publishers",
    "ForceThresholds": "legs",
    "HeadingNoise": "source_noise",
    "ImuNoise": "invariant_filter",
    "ImuPublisher": "publishers",
    "LegNoise": "legs",
    "Legs": "legs",
    "MagneticFieldPublisher": "publishers",
    "MagnetometerNoise": "source_noise",
    "MapCorrection": "map_correction",
    "MapEstimator": "map_estimator",
    "MapState": "map_estimator",
    "Mecanum": "wheels",
    "OdometryNode": "node",
    "OdometryPublisher": "publishers",
    "PoseNoise": "source_noise",
    "RelativeNoise": "source_noise",
    "PosePublisher": "publishers",
    "PressurePublisher": "publishers",
    "SensorListener": "node",
    "SimulatedRover": "simulated_rover",
    "SimulatedWheels": "simulated_rover",
    "SourceHealth": "health",
    "SpeedThresholds": "legs",
    "VelocityNoise": "source_noise",
    "VelocityPublisher": "publishers",
    "WheelNoise": "wheels",
    "WheelVelocity": "wheels",
    "Wheels": "wheels",
    "earth_field": "magnetism",
    "request_odometry": "requests",
}

if not TYPE_CHECKING:  # type checkers would take any name for one of the package
    __getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return __all__
