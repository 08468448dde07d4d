"""One system without a diagram: the descriptor computes ellipsoids of point clouds."""

import numpy as np

from drake_oa.common.messages import ObstacleClouds
from drake_oa.descriptor.ellipsoid_descriptor import EllipsoidDescriptor


def main() -> None:
    """Computes the ellipsoid of a small cube, dilated by a stick-like tool."""
    cube = np.array([[x, y, z] for x in (0.4, 0.5) for y in (-0.05, 0.05) for z in (0.0, 0.1)])
    stick = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.2]])

    descriptor = EllipsoidDescriptor(tool_W=stick)
    context = descriptor.CreateDefaultContext()
    clouds = ObstacleClouds(stamp=0.0, clouds_W=(cube,), ids=np.array([7]))
    descriptor.GetInputPort("obstacles_W").FixValue(context, clouds)
    ellipsoids = descriptor.GetOutputPort("ellipsoids_W").Eval(context)

    print(f"obstacle {ellipsoids.ids[0]}")
    print(f"  center    {ellipsoids.p_WO[0].round(3)} m")
    print(f"  semi-axes {ellipsoids.semi_axes[0].round(3)} m")


if __name__ == "__main__":
    main()
