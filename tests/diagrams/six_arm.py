"""Robot arm with six joints and without fingers, independent of the Panda."""

import re
from collections.abc import Callable
from pathlib import Path

from drake_oa.scenario.loading import parse_scenario
from drake_oa.scenario.scenario import Scenario

SIX_HOME = [0.3, -1.5708, 1.5708, -1.5708, -1.5708, 0.0]
"""Home positions of the six joints [rad]."""

_LINKS = [
    ("pan", "0 0 0.1625", "0 0 0", "0.12 0.12 0.12", "0 0 0"),
    ("lift", "0 0 0", "1.5707963 0 0", "0.425 0.1 0.1", "-0.2125 0 0.13"),
    ("elbow", "-0.425 0 0", "0 0 0", "0.392 0.08 0.08", "-0.196 0 0.02"),
    ("wrist1", "-0.3922 0 0.1333", "0 0 0", "0.08 0.1 0.08", "0 -0.02 0"),
    ("wrist2", "0 -0.0997 0", "1.5707963 0 0", "0.08 0.1 0.08", "0 0.02 0"),
    ("wrist3", "0 0.0996 0", "1.5707963 3.1415927 3.1415927", "0.08 0.08 0.04", "0 0 -0.02"),
]
"""Joints with the dimensions of a UR5e: name, xyz and rpy in the parent link, and size and center
of the link's box."""

_SCENARIO = f"""
task: {{start: [0.5, -0.3, 0.35], goal: [0.5, 0.3, 0.35], duration: 2.0, clearance: 0.08}}
compute_latency: null
robot:
  model: six.urdf
  base_link: foot
  # Its x axis points back, as a UR5e's does.
  X_WB: {{rpy: [0, 0, 3.1415927]}}
  hand_link: wrist3
  p_HE: [0, 0, 0.1]
  tool_links: [wrist3]
  q_seed: {SIX_HOME}
perception: !GroundTruth {{}}
"""


def _body(name: str, size: str, at: str) -> str:
    """Returns the URDF of a link: a box with its size and center."""
    shape = f'<origin xyz="{at}"/><geometry><box size="{size}"/></geometry>'
    return f"""
  <link name="{name}">
    <inertial>
      <origin xyz="{at}"/><mass value="3"/>
      <inertia ixx="0.03" iyy="0.03" izz="0.03" ixy="0" ixz="0" iyz="0"/>
    </inertial>
    <collision>{shape}</collision><visual>{shape}</visual>
  </link>"""


def six_scenario(
    folder: Path, old: str = "", new: str | Callable[[re.Match], str] = ""
) -> Scenario:
    """Writes the arm's URDF to a folder, with `old` replaced by `new`; returns its scenario."""
    parts, parent = [_body("foot", "0.15 0.15 0.08", "0 0 0.04")], "foot"
    for name, xyz, rpy, size, at in _LINKS:
        parts.append(_body(name, size, at))
        parts.append(f"""
  <joint name="{name}_joint" type="revolute">
    <parent link="{parent}"/><child link="{name}"/><axis xyz="0 0 1"/>
    <origin xyz="{xyz}" rpy="{rpy}"/>
    <limit lower="-6.28" upper="6.28" velocity="3.14" effort="150"/>
  </joint>
  <transmission name="{name}">
    <type>transmission_interface/SimpleTransmission</type>
    <joint name="{name}_joint"/><actuator name="{name}_motor"/>
  </transmission>""")
        parent = name
    text = f'<?xml version="1.0"?>\n<robot name="six">{"".join(parts)}\n</robot>\n'
    (folder / "six.urdf").write_text(re.sub(old, new, text, flags=re.DOTALL))
    return parse_scenario(_SCENARIO, folder=folder)
