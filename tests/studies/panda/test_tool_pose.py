"""The tool's pose from its position and velocity."""

import inspect
import math
import re

import numpy as np
import pytest
from pydrake.math import RollPitchYaw

from drake_oa.studies.panda.tool_pose import ToolPose


def test_pose_is_ahead_of_the_position() -> None:
    R_WE = RollPitchYaw(math.pi, 0.0, 0.5).ToRotationMatrix()
    system = ToolPose(R_WE, look_ahead=0.1)
    context = system.CreateDefaultContext()
    system.GetInputPort("desired_position").FixValue(context, [1.0, 2.0, 3.0])
    system.GetInputPort("desired_velocity").FixValue(context, [0.0, -1.0, 2.0])
    X_WE = system.GetOutputPort("desired_pose").Eval(context)
    np.testing.assert_allclose(X_WE.translation(), [1.0, 1.9, 3.2])
    np.testing.assert_array_equal(X_WE.rotation().matrix(), R_WE.matrix())


def test_look_ahead_must_be_finite() -> None:
    with pytest.raises(ValueError, match="look_ahead must be finite"):
        ToolPose(RollPitchYaw(0.0, 0.0, 0.0).ToRotationMatrix(), look_ahead=math.nan)


def test_documented_ports_are_the_declared_ones() -> None:
    system = ToolPose(RollPitchYaw(0.0, 0.0, 0.0).ToRotationMatrix())
    listed = re.findall(r"^ +- (\w+)$", inspect.getdoc(ToolPose) or "", re.MULTILINE)
    ports = [system.get_input_port(i).get_name() for i in range(system.num_input_ports())]
    ports += [system.get_output_port(i).get_name() for i in range(system.num_output_ports())]
    assert listed == ports
