"""Shared modules of all layers; they import none of the layers.

- `messages`: immutable messages on the abstract ports between layers: `ObstacleClouds`,
  `EllipsoidSet`, `Route`, `CouplingParameters`, `PolicyState`, `PlannedMotion`. A copy is the
  message itself, so that a Context clones in constant time.
- `signal_builder`: a builder of diagrams that connects ports by the names of their signals.
- `ports`: typed reading of abstract input ports, and output ports of an abstract state.
- `config`: validation of configuration blocks: units, ranges, YAML data.
- `latency`: simulated compute latency of a decision (`LatencyModel`, block `compute_latency`),
  and the decision that stays active meanwhile (`PendingDecision`).
- `compiled`: decorators of numba kernels, and the folder of their machine code; `numba_tools`:
  its processor target.
- `files`: atomic replacement of files, software versions and source digest of a result.
- `console`: exit statuses, errors, tables and progress of the commands.

Units are SI. Frames follow Drake's monogram notation: p_WE is the position of the tool point E in
the world W, R_WO the orientation of O in W, v_WO its velocity in W.

Read first: `messages`.
"""
