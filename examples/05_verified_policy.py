"""Search a motion round two balls, and run the policy that goes it: no robot."""

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import CouplingParameters, EllipsoidSet
from drake_oa.policy.coupling import ALPHA, KAPPA, NORMAL, PSI
from drake_oa.policy.dmp import imitate, local_frame, minimum_jerk
from drake_oa.policy.dmp_integrator import DmpIntegrator
from drake_oa.regulation.proposal_network import load_proposals
from drake_oa.regulation.rollout import SpatialScenes
from drake_oa.regulation.search import verify
from drake_oa.scenario.shipped import package_file

START, GOAL = np.zeros(3), np.array([1.0, 0.0, 0.0])
BALLS, RADIUS = np.array([[0.5, 0.0, -0.02], [0.6, 0.0, 0.35]]), 0.1
CLEARANCE, DURATION = 0.1, 4.0


def main() -> None:
    """Bends a straight motion round two balls and prints how near it came."""
    scene = SpatialScenes(
        p_WE=START[None],
        z_W=np.zeros((1, 3)),
        p_WG=GOAL[None],
        R_WL=local_frame(START, GOAL)[None],
        baseline=np.ones(1),
        p_WO=BALLS[None],
        R_WO=np.tile(np.eye(3), (1, 2, 1, 1)),
        semi_axes=np.full((1, 2, 3), RADIUS),
        v_WO=np.zeros((1, 2, 3)),
        asked_clearance=np.full((1, 2), CLEARANCE),
    )
    proposer = load_proposals(package_file("package://drake_oa/weights/proposals.safetensors"))
    dmp = imitate(*minimum_jerk(START, GOAL, duration=DURATION))
    found = verify(scene, proposer, duration=DURATION)
    # One avoidance term about a point of its own: it belongs to neither ball.
    of_term = (found.terms[:, column] for column in (ALPHA, PSI, KAPPA))
    planes = found.terms[:, :3], found.terms[:, NORMAL : NORMAL + 3]
    tau = float(found.tau[0])
    coupling = CouplingParameters(*of_term, np.ones(1, bool), *planes, tau=tau, verified=True)

    policy = DmpIntegrator(dmp, START)
    simulator = Simulator(policy)
    context = simulator.get_mutable_context()
    policy.GetInputPort("goal").FixValue(context, GOAL)
    policy.GetInputPort("ellipsoids_W").FixValue(context, Value(EllipsoidSet(stamp=np.inf)))
    policy.GetInputPort("coupling_parameters").FixValue(context, Value(coupling))
    path = []
    for time in np.arange(0.0, 8.0, 0.02):
        simulator.AdvanceTo(time)
        path.append(policy.GetOutputPort("desired_position").Eval(context))
    kept = np.linalg.norm(np.array(path)[:, None] - BALLS, axis=2).min() - RADIUS
    print(f"asked {CLEARANCE:.3f} m, kept {kept:.3f} m, ended at {path[-1].round(4)}")


if __name__ == "__main__":
    main()
