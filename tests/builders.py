"""Helpers that tests of several folders share."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import SceneGraph, Shape
from pydrake.math import RigidTransform
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    CoulombFriction,
    MultibodyPlant,
)
from pydrake.multibody.tree import RevoluteJoint, RigidBody, SpatialInertia
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, System
from pydrake.systems.sensors import ImageDepth32F

from drake_oa.app.main import main
from drake_oa.common.messages import EllipsoidSet, FloatArray
from drake_oa.perception.coverage import points_near, unobserved_share
from drake_oa.runs.camera_placement import spheres_along, view_volumes
from drake_oa.scenario.scenario import Scenario


def unseen_near(scenario: Scenario) -> float:
    """Returns the fraction of the space near the arm that no camera of a scenario observes."""
    views = view_volumes(scenario, scenario.perception)
    spheres = spheres_along(scenario)
    return unobserved_share(*spheres, points_near(*spheres, scenario.table_height), views)


def balls(
    *centers: Sequence[float],
    radius: ArrayLike = 0.1,
    stamp: float = 0.0,
    ids: Sequence[int] | None = None,
    **more: object,
) -> EllipsoidSet:
    """Returns balls at the centers [m]; three radii give ellipsoids along the world's axes."""
    count = len(centers)
    return EllipsoidSet(
        stamp=stamp,
        p_WO=np.array(centers, dtype=float).reshape(count, 3),
        R_WO=np.tile(np.eye(3), (count, 1, 1)),
        semi_axes=np.full((count, 3), radius),
        v_WO=np.zeros((count, 3)),
        ids=np.arange(count) if ids is None else np.array(ids),
        **more,  # type: ignore[arg-type]
    )


def depth_image(depth: np.ndarray) -> ImageDepth32F:
    """Returns a Drake image of a depth array (H, W) [m]."""
    image: Any = ImageDepth32F(depth.shape[1], depth.shape[0])
    image.mutable_data[:, :, 0] = depth
    return image


def read(system: System, context: Context, port: str) -> FloatArray:
    """Returns the value of a vector output port of a system."""
    return np.array(system.GetOutputPort(port).Eval(context))


def hinged_shapes(
    shapes: Sequence[Shape], X_BG: RigidTransform
) -> tuple[Diagram, MultibodyPlant, SceneGraph, RigidBody]:
    """Builds a plant with collision geometries on one body, which a joint rotates about z."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    instance = plant.AddModelInstance("arm")
    inertia = SpatialInertia.SolidSphereWithMass(1.0, 0.1)
    body = plant.AddRigidBody("link", instance, inertia)
    plant.AddJoint(RevoluteJoint("hinge", plant.world_frame(), body.body_frame(), [0.0, 0.0, 1.0]))
    for number, shape in enumerate(shapes):
        plant.RegisterCollisionGeometry(body, X_BG, shape, f"g{number}", CoulombFriction())
    plant.Finalize()
    return builder.Build(), plant, scene_graph, body


def command(*arguments: object) -> int:
    """Runs `drake-oa` with arguments, and returns its exit status."""
    try:
        return main([str(argument) for argument in arguments])
    except SystemExit as ended:
        return int(ended.code or 0)
