"""Models of robots that others made, as Drake takes them.

In: a file of `robot.model`, as URDF, SDF or MJCF, and where its packages are. Out: the text of
the same model with meshes as .obj, joints that are driven, and a base that can be welded
(`model_file.drake_model`), or None where Drake takes it as it is. Converted meshes are in the
user's cache folder, drake_oa/meshes-2, by what was in them, or in a temporary folder where that
cannot be written; nothing is written beside a model.

- `model_file`: finds packages of Python, and chooses by the file's suffix.
- `urdf`: URDF and SDF. `mjcf`: MuJoCo's.
- `meshes`: .stl and what else open3d reads, and .dae by pycollada, as .obj; collision meshes as few
  convex hulls.

Begin with `model_file.drake_model`.
"""
