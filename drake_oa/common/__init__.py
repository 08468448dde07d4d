"""Package of the modules that all layers of the diagram share: messages, signals, configuration,
files.

These modules do not import any layer.

- `messages`: immutable messages on the abstract ports between layers: `ObstacleClouds`,
  `EllipsoidSet`, `Route`, `CouplingParameters`, `PolicyState`, `PlannedMotion`. Copying a message
  returns the same object, so that a Context clones in constant time.
- `signal_builder`: a builder of diagrams that connects ports by signals, which are named values.
- `ports`: abstract input ports with a check of the type of their values, and output ports that
  publish attributes of a system's abstract state.
- `config`: validation of configuration blocks: units, ranges, YAML data.
- `latency`: simulated compute latency (`LatencyModel`, block `compute_latency`) of decisions, the
  periodic computations of a layer such as a motion search; and a decision that is being computed
  while the previous one stays active (`PendingDecision`).
- `compiled`: decorators of functions that numba compiles (kernels), and the folder that caches the
  machine code of the kernels; `numba_tools`: the processor for which this code is generated.
- `files`: atomic replacement of files; the software versions, and the digest (hash) of the source
  files, that are saved with a result.
- `bags`: ROS 2 messages, and the files to which they are written.
- `console`: exit statuses, errors, tables and progress of the commands.

Units are SI. Frames follow Drake's monogram notation. p_WE is the position of the tool point E in
the world W. R_WO is the orientation and v_WO the velocity of an obstacle O in W.

Read first: `messages`.
"""
