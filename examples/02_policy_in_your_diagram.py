"""Policy in your own diagram: it avoids a given ellipsoid, without a robot."""

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource, LogVectorOutput

from drake_oa.common.files import package_file
from drake_oa.common.messages import EllipsoidSet
from drake_oa.inference.regressor import load_chain
from drake_oa.inference.regressor_chain import RegressorChain
from drake_oa.policy.dmp import imitate, minimum_jerk
from drake_oa.policy.dmp_integrator import DmpIntegrator
from drake_oa.route.cost_ring_selector import CostRingSelector

START, GOAL = np.zeros(3), np.array([1.0, 0.0, 0.0])
CLEARANCE = 0.1


def main() -> None:
    """Avoids a ball on a straight motion by the paper's method; prints the minimum clearance."""
    ball = EllipsoidSet(
        stamp=np.inf,  # Never stale.
        p_WO=np.array([[0.5, 0.0, -0.02]]),
        R_WO=np.eye(3)[None],
        semi_axes=np.full((1, 3), 0.1),
        v_WO=np.zeros((1, 3)),
        ids=np.array([0]),
    )
    weights = load_chain(package_file("package://drake_oa/weights/paper_chain_running.safetensors"))

    builder = DiagramBuilder()
    goal = builder.AddSystem(ConstantVectorSource(GOAL))
    obstacles = builder.AddSystem(ConstantValueSource(Value(ball)))
    chain = builder.AddSystem(RegressorChain(weights, CLEARANCE))
    rings = builder.AddSystem(CostRingSelector(CLEARANCE))
    dmp = imitate(*minimum_jerk(START, GOAL, duration=4.0))
    policy = builder.AddSystem(DmpIntegrator(dmp, START))
    for system in (chain, rings, policy):
        builder.Connect(obstacles.get_output_port(), system.GetInputPort("ellipsoids_W"))
    for system in (chain, rings):
        builder.Connect(policy.GetOutputPort("policy_state"), system.GetInputPort("policy_state"))
    for system in (rings, policy):
        builder.Connect(goal.get_output_port(), system.GetInputPort("goal"))
    builder.Connect(
        chain.GetOutputPort("coupling_parameters"), policy.GetInputPort("coupling_parameters")
    )
    builder.Connect(rings.GetOutputPort("decision"), policy.GetInputPort("route"))
    log = LogVectorOutput(policy.GetOutputPort("desired_position"), builder, 0.01)

    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(8.0)
    path = log.FindLog(simulator.get_context()).data().T
    min_clearance = np.linalg.norm(path - ball.p_WO[0], axis=1).min() - 0.1
    print(f"requested clearance {CLEARANCE:.3f} m, min. clearance {min_clearance:.3f} m")


if __name__ == "__main__":
    main()
