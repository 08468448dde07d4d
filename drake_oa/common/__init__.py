"""Shared modules of all layers; they import none of them.

- `messages`: the frozen values on the abstract ports between layers: `ObstacleClouds`,
  `EllipsoidSet`, `Route`, `CouplingParameters`, `PolicyState`, `PlannedMotion`. Arrays
  are locked, and a copy is the value itself, so that a Context clones in constant time.
- `signals`: signals of a diagram by name: systems are added, replaced and put between by them.
- `ports`: typed reading of abstract ports; a robot's plant as a cache entry of a system.
- `config`: fields of configuration blocks with unit and range, and YAML data held against them.
- `compute_latency`: what a decision costs in simulated time (`LatencyModel`, block `compute_latency`), and what is
  in force until it is made (`PendingDecision`).
- `compiled`: decorators of kernels, and the place of their compiled code; `numba_tools`: its
  processor target.
- `files`: atomic replacement of files, versions and source of a result.
- `console`: exit statuses and errors of the commands.

Units are SI, frames monogram notation: p_WE is the tool point E in the world W, R_WO the
orientation of O in W, v_WO its velocity in W.

Begin with `messages`.
"""
