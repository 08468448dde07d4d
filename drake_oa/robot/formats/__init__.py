"""Models of robots that others made, as Drake reads them.

In: a file of `robot.model`, as URDF, SDF or MJCF, and where its packages are. Out: the elements of
the same model with meshes as .obj, joints that are driven, and a base that can be welded
(`model_file.changed_model`), or None for an SDF, which Drake reads as it is. Converted meshes are
in the user's cache folder, drake_oa/meshes-4, by their content; nothing is written beside a model.

- `model_file`: finds packages of Python, checks links, and chooses by the file's suffix.
- `urdf`: URDF. `mjcf`: MuJoCo's.
- `meshes`: .stl and what else open3d reads, and .dae by pycollada, as .obj; collision meshes as few
  convex hulls.

Begin with `model_file.changed_model`.
"""
