"""Values that follow from a scenario's perception block: periods, margins, given ellipsoids."""

from __future__ import annotations

import dataclasses as dc

import numpy as np
from pydrake.math import RollPitchYaw
from pydrake.systems.sensors import CameraConfig

from drake_oa.common.messages import EllipsoidSet, TablePlane
from drake_oa.perception.config import CameraSource, DepthCamera, LcmCamera, RecordedClouds
from drake_oa.scenario.perception import GivenEllipsoids
from drake_oa.scenario.scenario import Scenario

_SURFACE_GAP = 0.01
"""Maximum depth of a link in a surface between the points that ground truth has of it [m]."""


_GIVEN_PERIOD = 1.0 / 15.0
"""Time between observations of given ellipsoids [s]."""
_ODD = 0x9E3779B97F4A7C15
"""The golden ratio's 64 bits: seeds apart by multiples of it have little in common."""


def noise_seed(scenario: Scenario, camera: str) -> int:
    """Returns the seed of a camera's noise; that of the first camera is the scenario's."""
    source = scenario.perception
    row = source.names.index(camera) if isinstance(source, CameraSource) else 0
    return (scenario.seed + row * _ODD) % 2**63


def camera_configs(scenario: Scenario, source: CameraSource) -> list[CameraConfig]:
    """Returns the configurations of the cameras of perception, in its order."""
    named = {config.name: config for config in scenario.cameras}
    return [named[name] for name in source.names]


def simulated(scenario: Scenario) -> Scenario:
    """The scenario with simulated cameras in the place of those outside the simulation."""
    source = scenario.perception
    if not isinstance(source, LcmCamera):
        return scenario
    shared = {item.name: getattr(source, item.name) for item in dc.fields(DepthCamera)}
    return dc.replace(scenario, perception=DepthCamera(**shared))


def given_ellipsoids(source: GivenEllipsoids) -> EllipsoidSet:
    """The ellipsoids of a `!GivenEllipsoids` block; they are never out of date."""
    items = source.ellipsoids
    return EllipsoidSet(
        stamp=np.inf,
        p_WO=np.array([item.center for item in items], dtype=float).reshape(-1, 3),
        R_WO=np.array(
            [RollPitchYaw(item.rpy).ToRotationMatrix().matrix() for item in items]
        ).reshape(-1, 3, 3),
        semi_axes=np.array([item.semi_axes for item in items], dtype=float).reshape(-1, 3),
        v_WO=np.zeros((len(items), 3)),
        ids=np.arange(len(items)),
    )


def table_plane(scenario: Scenario) -> TablePlane | None:
    """The table that the scenario tells of, in the world; None where it has none."""
    return None if scenario.table_height is None else TablePlane(offset=scenario.table_height)


def perception_period(scenario: Scenario) -> float:
    """Time between observations [s]."""
    source = scenario.perception
    if isinstance(source, CameraSource):
        return 1.0 / camera_configs(scenario, source)[0].fps
    if isinstance(source, GivenEllipsoids):
        return _GIVEN_PERIOD
    return source.period


def padding(source: object) -> float:
    """Returns the maximum distance of an obstacle's surface outside its observed points [m]."""
    if isinstance(source, (CameraSource, RecordedClouds)):
        return 0.5 * source.segmentation.voxel
    return _SURFACE_GAP
