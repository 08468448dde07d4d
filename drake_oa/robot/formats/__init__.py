"""Conversion of robot models from other packages, so that Drake can read them.

Input: the file `robot.model`, as URDF, SDF or MJCF, and a package map. Output of
`model_file.converted_model`: the XML elements of the same model, with meshes as .obj files,
actuated joints, and a base that can be welded to the world. The output is None for an SDF, which
needs no conversion. Converted meshes are stored in the user's cache folder drake_oa/meshes-4, by a
digest of their content. No file is written next to a model.

- `model_file`: adds Python packages to the package map, checks links, and selects the conversion by
  file suffix.
- `urdf`: conversion of URDF. `mjcf`: conversion of MuJoCo's format MJCF.
- `meshes`: conversion of .stl, .dae (with pycollada) and other formats of open3d to .obj; a
  collision mesh becomes few convex hulls.

Read `model_file.converted_model` first.
"""
