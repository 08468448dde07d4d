"""Put the policy with verified regulation into a diagram of your own: no rings, no robot."""

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput

from drake_oa.common.messages import EllipsoidSet
from drake_oa.descriptor.ellipsoid_descriptor import GivenEllipsoidSource
from drake_oa.policy.dmp import imitate, minimum_jerk
from drake_oa.policy.dmp_integrator import DmpIntegrator
from drake_oa.regulation.regressor import load_chain
from drake_oa.regulation.verified_regressor_chain import VerifiedRegressorChain
from drake_oa.scenario.loading import package_file

START, GOAL = np.zeros(3), np.array([1.0, 0.0, 0.0])
CLEARANCE = 0.1


def main() -> None:
    """Bends a straight motion round two balls and prints how near it came."""
    balls = EllipsoidSet(
        stamp=np.inf,  # Never out of date.
        p_WO=np.array([[0.5, 0.0, -0.02], [0.6, 0.0, 0.35]]),
        R_WO=np.tile(np.eye(3), (2, 1, 1)),
        semi_axes=np.full((2, 3), 0.1),
        v_WO=np.zeros((2, 3)),
        ids=np.array([0, 1]),
    )
    weights = load_chain(package_file("package://drake_oa/weights/regressor_chain.safetensors"))
    # Regulation and policy must have the same primitive.
    dmp = imitate(*minimum_jerk(START, GOAL, duration=4.0))

    builder = DiagramBuilder()
    goal = builder.AddSystem(ConstantVectorSource(GOAL))
    seen = builder.AddSystem(GivenEllipsoidSource(balls))
    chain = builder.AddSystem(VerifiedRegressorChain(weights, dmp, CLEARANCE))
    policy = builder.AddSystem(DmpIntegrator(dmp, START))
    for system in (chain, policy):
        builder.Connect(seen.get_output_port(), system.GetInputPort("ellipsoids_W"))
        builder.Connect(goal.get_output_port(), system.GetInputPort("goal"))
    builder.Connect(policy.GetOutputPort("policy_state"), chain.GetInputPort("policy_state"))
    builder.Connect(
        chain.GetOutputPort("coupling_parameters"), policy.GetInputPort("coupling_parameters")
    )
    log = LogVectorOutput(policy.GetOutputPort("desired_position"), builder, 0.01)

    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(8.0)
    root = simulator.get_context()
    path = log.FindLog(root).data().T
    nearest = np.linalg.norm(path[:, None] - balls.p_WO, axis=2).min() - 0.1
    shortfall = chain.GetOutputPort("shortfall").Eval(chain.GetMyContextFromRoot(root))[0]
    print(f"asked {CLEARANCE:.3f} m, kept {nearest:.3f} m, ended at {path[-1].round(4)}")
    print(f"short of what can be kept: {1e3 * shortfall:.1f} mm")


if __name__ == "__main__":
    main()
