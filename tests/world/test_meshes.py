"""Meshes without normals, which Drake's renderers reject."""

from pathlib import Path

from drake_oa.runs.scenario_check import build_problems
from drake_oa.scenario.loading import load_scenario

TETRAHEDRON = """
v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
f 1 3 2
f 1/1 2/2 4/4
f -4 -1 -2
f 2 3 {last}
"""
SDF = """
<sdf version="1.9"><model name="m"><link name="body">
  <visual name="v"><geometry><mesh><uri>mesh.obj</uri></mesh></geometry></visual>
</link></model></sdf>
"""
SCENARIO = """
directives:
- add_directives: {file: package://drake_oa/scenes/camera_xtion.dmd.yaml}
- add_model: {name: obstacle_mesh, file: mesh.sdf}
- add_weld: {parent: world, child: obstacle_mesh::body}
cameras:
- {name: camera, X_PB: {base_frame: camera_mount::camera}, rgb: false, depth: true}
perception: !DepthCamera {camera: camera}
"""


def test_mesh_relative_to_the_scenario_is_rendered_or_named_in_the_error(tmp_path: Path) -> None:
    (tmp_path / "mesh.sdf").write_text(SDF)
    (tmp_path / "own.yaml").write_text(SCENARIO)
    (tmp_path / "mesh.obj").write_text(TETRAHEDRON.format(last=4))
    assert build_problems(load_scenario(str(tmp_path / "own.yaml"))) == []
    (tmp_path / "mesh.obj").write_text("v 0 0 0\n")
    (problem,) = build_problems(load_scenario(str(tmp_path / "own.yaml")))
    assert problem.startswith("directives: ")
    assert "mesh.obj" in problem
