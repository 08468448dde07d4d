"""Search a motion round two balls, and run the policy that executes it: no robot."""

import dataclasses as dc

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import EllipsoidSet
from drake_oa.inference.config import Verified
from drake_oa.planning.point_search import PointSearch
from drake_oa.planning.search import avoidance_terms, rows_of
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import imitate, local_frame, minimum_jerk
from drake_oa.policy.dmp_integrator import DmpIntegrator
from drake_oa.policy.rollout import Scene

START, GOAL, CLEARANCE, DURATION = np.zeros(3), np.array([1.0, 0.0, 0.0]), 0.1, 4.0
CENTERS, RADIUS = np.array([[0.5, 0.0, -0.02], [0.6, 0.0, 0.35]]), 0.1
BALLS = EllipsoidSet(
    stamp=np.inf,
    p_WO=CENTERS,
    R_WO=np.tile(np.eye(3), (2, 1, 1)),
    semi_axes=np.full((2, 3), RADIUS),
    v_WO=np.zeros((2, 3)),
    ids=np.arange(2),
)


def main() -> None:
    """Bends a straight motion round two balls and prints how near it came."""
    R_WL, still = local_frame(START, GOAL), np.zeros(3)
    scene = Scene(START, still, GOAL, R_WL, 1.0, BALLS, np.full(2, CLEARANCE))
    dmp = imitate(*minimum_jerk(START, GOAL, duration=DURATION))
    search = PointSearch(scene, dmp=dmp, policy=Policy(), parameters=Verified())
    found = search.run()
    # One avoidance term about a point of its own: it belongs to neither ball.
    rows = rows_of(avoidance_terms(scene, found.params))
    coupling = dc.replace(rows, tau=max(float(found.length[0]), 1.0), verified=True)

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
    kept = np.linalg.norm(np.array(path)[:, None] - CENTERS, axis=2).min() - RADIUS
    print(f"asked {CLEARANCE:.3f} m, kept {kept:.3f} m, ended at {path[-1].round(4)}")


if __name__ == "__main__":
    main()
