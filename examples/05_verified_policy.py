"""Search of a motion past two balls, and its execution by the policy, without a robot."""

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
    """Avoids two balls on a straight motion, and prints the minimum clearance."""
    R_WL, v_start = local_frame(START, GOAL), np.zeros(3)
    scene = Scene(START, v_start, GOAL, R_WL, 1.0, BALLS, np.full(2, CLEARANCE))
    dmp = imitate(*minimum_jerk(START, GOAL, duration=DURATION))
    search = PointSearch(scene, dmp=dmp, policy=Policy(), parameters=Verified())
    result = search.run()
    # The avoidance term acts about a separate point, which belongs to neither ball.
    rows = rows_of(avoidance_terms(scene, result.params))
    coupling = dc.replace(rows, tau=max(float(result.length[0]), 1.0), verified=True)

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
    min_clearance = np.linalg.norm(np.array(path)[:, None] - CENTERS, axis=2).min() - RADIUS
    print(f"requested clearance {CLEARANCE:.3f} m, min. clearance {min_clearance:.3f} m")


if __name__ == "__main__":
    main()
