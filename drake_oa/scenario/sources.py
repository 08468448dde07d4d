"""Values that follow from a scenario's perception block or table, such as observation period,
padding of surfaces, and noise seeds.
"""

from __future__ import annotations

import dataclasses as dc

import numpy as np
from pydrake.common.schema import Transform
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.sensors import CameraConfig

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import EllipsoidSet, TablePlane
from drake_oa.perception.config import CameraSource, DepthCamera, RecordedClouds
from drake_oa.scenario.perception import GivenEllipsoids
from drake_oa.scenario.scenario import Scenario

_SURFACE_GAP = 0.01
"""Padding of the surface points that ground-truth perception outputs: maximum depth to which a
robot link can penetrate the surface of an obstacle between these points [m]."""


_GIVEN_PERIOD = 1.0 / 15.0
"""Time between two observations if a scenario gives the obstacles as ellipsoids
(`!GivenEllipsoids`) [s]."""
_SEED_INCREMENT = 0x9E3779B97F4A7C15
"""Difference between the seeds of the image noise of two successive cameras [-]. The value is 2^64
divided by the golden ratio, so that the seeds are uncorrelated."""


def noise_seed(scenario: Scenario, camera: str) -> int:
    """Returns the seed of a camera's image noise, which is different for each camera; the first
    camera has the seed of the scenario.
    """
    source = scenario.perception
    row = source.names.index(camera) if isinstance(source, CameraSource) else 0
    return (scenario.seed + row * _SEED_INCREMENT) % 2**63


def camera_configs(scenario: Scenario, source: CameraSource) -> list[CameraConfig]:
    """Returns the configurations of the cameras that a perception block uses, in the order of its
    camera names.
    """
    named = {config.name: config for config in scenario.cameras}
    return [named[name] for name in source.names]


def with_simulated_cameras(scenario: Scenario) -> Scenario:
    """Returns a copy of a scenario whose cameras are simulated: the block `!DepthCamera` replaces
    `!LcmCamera` (images by LCM) and `!RecordedBag` (images from a ROS 2 bag).

    A scenario without cameras in its perception block is returned unchanged.
    """
    source = scenario.perception
    if not isinstance(source, CameraSource):
        return scenario
    shared = {item.name: getattr(source, item.name) for item in dc.fields(DepthCamera)}
    return dc.replace(scenario, perception=DepthCamera(**shared))


def fixed_transform(transform: Transform | None, field: str) -> RigidTransform | None:
    """Returns the pose in the world that a field of a perception block sets; None if the field is
    null.

    Args:
        transform: value of the field, a transform of Drake's schema, which may be random.
        field: name of the field, for error messages.

    Raises:
        ScenarioError: for a pose that is random or relative to another frame; names the field.
    """
    if transform is None:
        return None
    if transform.base_frame not in (None, "", "world"):
        raise ScenarioError(
            f"{field}.base_frame: must be 'world', not '{transform.base_frame}'; leave it out"
        )
    if not transform.IsDeterministic():
        raise ScenarioError(f"{field}: must be one fixed pose, not a random one")
    return transform.GetDeterministicValue()


def given_ellipsoids(source: GivenEllipsoids) -> EllipsoidSet:
    """Converts a `!GivenEllipsoids` block to the ellipsoids of obstacles at rest, with an infinite
    time stamp, so that they never count as stale.
    """
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
    """Returns the horizontal plane at the field `table_height` of a scenario; None if the field is
    null.
    """
    return None if scenario.table_height is None else TablePlane(offset=scenario.table_height)


def perception_period(scenario: Scenario) -> float:
    """Returns the time between two observations of the obstacles in a scenario [s]."""
    source = scenario.perception
    if isinstance(source, CameraSource):
        return 1.0 / camera_configs(scenario, source)[0].fps
    if isinstance(source, GivenEllipsoids):
        return _GIVEN_PERIOD
    return source.period


def padding(source: object) -> float:
    """Returns the padding of observed points for a perception block: the maximum distance by which
    an obstacle's surface lies outside the points [m].
    """
    if isinstance(source, (CameraSource, RecordedClouds)):
        return 0.5 * source.segmentation.voxel
    return _SURFACE_GAP
