"""Reactive obstacle avoidance of robot arms as Drake systems, by the method of Pairet et al., RA-L
2019.

`from drake_oa import DepthPerception` imports the Drake system of a layer (perception, descriptor,
route, inference, planning, policy, posture, safety, control or viewing). The module of a system is
imported only at the first access to the system.
"""

from importlib import import_module as _import_module

from drake_oa.common.numba_tools import pin_processor_target as _pin_processor_target

# This must precede the import of every module with compiled functions.
_pin_processor_target()

_SYSTEMS = {
    "DepthPerception": "perception.depth_perception",
    "GroundTruthPerception": "perception.ground_truth_perception",
    "RecordedPerception": "perception.recorded_perception",
    "EllipsoidDescriptor": "descriptor.ellipsoid_descriptor",
    "GivenEllipsoidSource": "descriptor.ellipsoid_descriptor",
    "CostRingSelector": "route.cost_ring_selector",
    "RegressorChain": "inference.regressor_chain",
    "MotionVerifier": "planning.motion_verifier",
    "GroundTruthScene": "planning.ground_truth_scene",
    "PerceivedScene": "planning.perceived_scene",
    "DmpIntegrator": "policy.dmp_integrator",
    "OrientationIntegrator": "policy.orientation_integrator",
    "NominalPostureSource": "posture.nominal_posture_source",
    "MotionGuard": "safety.motion_guard",
    "JointInverseDynamics": "control.joint_inverse_dynamics",
    "CartesianInverseDynamics": "control.cartesian_inverse_dynamics",
    "MeshcatOverlay": "viewing.meshcat_overlay",
}
"""Modules of the exported Drake systems, relative to this package, by class name of the system."""

__all__ = list(_SYSTEMS)


def __getattr__(name: str) -> type:
    """Returns the class of an exported Drake system, whose module is imported at the first access.

    Raises:
        AttributeError: if no exported Drake system has this name.
    """
    if name not in _SYSTEMS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    system: type = getattr(_import_module(f"{__name__}.{_SYSTEMS[name]}"), name)
    return system


def __dir__() -> list[str]:
    """Returns the names in this package, including the exported Drake systems that are not imported
    yet.
    """
    return [*globals(), *_SYSTEMS]
