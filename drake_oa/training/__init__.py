"""Training of the regressor chain: from roll-outs to the weights that regulation reads.

The chain maps a section and a clearance to coupling parameters, one network after the other:
Y1: h -> kappa, Y2: (h, kappa) -> psi, Y3: (h, kappa, psi) -> alpha (the paper, "Geometry-
conditioned Parameter Regressor"). Nothing here runs beside the robot, and nothing of it is
imported at run time: what comes out is a `.safetensors` file, which
`drake_oa.regulation.regressor.load_chain` reads and evaluates compiled.

Everything happens in the plane of actuation and in normalised units: lengths in baselines L
from start (0, 0) to goal (1, 0), alpha per duration T, kappa in 1/L^2, psi in rad. Two recipes,
`drake-oa train --recipe`:

- `project`: the chain that is shipped. `dataset` explores (kappa, psi, alpha) around a lattice
  of ellipses, chooses one triple for each asked clearance and solves for the alpha that keeps
  it exactly; `chain` trains; `validation` rolls out what the chain proposes elsewhere.
- `paper`: RC(lambda') and RC(lambda', Delta) on the paper's own set of 12.5 million motions of the
  authors' released code. `paper_set` makes the set, `paper` trains and prints Table I
  beside the printed one.

Method: `planar_rollout` integrates both motions, compiled, one row a trajectory, on all cores. The
networks (24-24-24 tanh, linear output, float64) are `torch.nn.Module`s; `levenberg_marquardt` fits
them by damped Gauss-Newton steps (Levenberg 1944, Marquardt 1963): J by `torch.func` a block of
rows at a time, J^T J and J^T e summed up, a Cholesky factor a step. CPU and CUDA run
the same lines; a seed decides split, scatter and first weights.

`session` is the command. It keeps what was computed in a folder (`checkpoint`): after an
interruption the same command goes on to the same result. There is no block in the scenario but
`policy.weights`, the file to use.

Read `chain.py` first, then `dataset.py`; results are in docs/results/training_project.md and
training_paper.md.
"""
