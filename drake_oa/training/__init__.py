"""Training of the networks that inference evaluates: `drake-oa train`.

In: a recipe. Out: a .safetensors file with a network, the range that it was trained in, and where
it comes from. Nothing here runs on the robot, and nothing that runs there imports it. Lengths are
in baselines L (semi-axes lambda1', lambda2' along and across, clearance Delta), kappa in 1/L^2, psi
in rad, alpha in 1/T; `paper` has meters and rad/s, on L = 1 m.

Recipe `paper` (`PaperRecipe`): Table I of the paper.

1. `lattice` rolls out the paper's lattice of 12.5 million motions on the action level of the
   authors' released code (`released_law`); `paper` keeps those with a clearance of at least 1 cm
   and estimates their noise.
2. `paper` trains RC(lambda') and RC(lambda', Delta), and puts the scores beside the printed ones.

Recipe `paper_running`: the same on the running system's action level (`lattice.running_paths`).

The chains' networks are `torch.nn` modules of 24-24-24 tanh units (`networks`), fitted by
Levenberg-Marquardt (after Hagan and Menhaj 1994) with derivatives by
`torch.func`, in float64, on the CPU: the same seed gives the same weights on the same machine.

Results: docs/results/learning.md; the choices, with measurements: docs/theory/inference.md.
Read `paper` first.
"""
