"""Normals for meshes that have none."""

from pathlib import Path

import numpy as np
import pytest

from drake_oa.runs.scenario_check import unbuildable
from drake_oa.scenario.loading import load_scenario
from drake_oa.world.meshes import with_normals

TETRAHEDRON = """
mtllib none.mtl
v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
usemtl none
f 1 3 2
f 1/1 2/2 4/4
f -4 -1 -2
f 2 3 4
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


def test_each_face_has_its_normal() -> None:
    text = with_normals(TETRAHEDRON)
    assert text is not None
    normals = [line.split()[1:] for line in text.splitlines() if line.startswith("vn")]
    third = 3**-0.5
    expected = [[0, 0, -1], [0, -1, 0], [-1, 0, 0], [third] * 3]
    np.testing.assert_allclose(np.array(normals, float), expected, atol=1e-9)
    faces = [line for line in text.splitlines() if line.startswith("f")]
    assert faces == ["f 1//1 3//1 2//1", "f 1//2 2//2 4//2", "f 1//3 4//3 3//3", "f 2//4 3//4 4//4"]
    assert "mtl" not in text
    assert with_normals(text) is None


@pytest.mark.parametrize("face", ["f 1 2", "f 1 2 9", "f 1 2 -9"])
def test_a_face_without_its_vertices_is_refused(face: str) -> None:
    with pytest.raises(ValueError, match="'mesh', line 12: a face needs at least 3 of the 4"):
        with_normals(TETRAHEDRON + face)


def test_a_model_beside_the_scenario_is_found_and_seen(tmp_path: Path) -> None:
    for name, text in (("mesh.obj", TETRAHEDRON), ("mesh.sdf", SDF), ("own.yaml", SCENARIO)):
        (tmp_path / name).write_text(text)
    assert unbuildable(load_scenario(str(tmp_path / "own.yaml"))) == []
