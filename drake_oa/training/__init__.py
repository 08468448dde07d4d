"""Training of the regressor chains that inference evaluates: `drake-oa train`.

A regressor chain predicts the parameters kappa, psi and alpha of a coupling term, which turns the
motion away from an obstacle. It has one network for each parameter, in this order. The inputs of a
network are the inputs of the chain, and the parameters that the networks before predict. The inputs
of the chain are lambda1' and lambda2', the semi-axes of the obstacle's section along and across the
baseline (line from start to goal), and in RC(lambda', Delta) the requested clearance Delta.

Lengths are in units of the baseline's length L, kappa in 1/L^2, psi in rad, and alpha in 1/T (T:
demonstrated duration); in the recipe `paper` alpha is in rad/s and L = 1 m.

A recipe states the training set, and the numbers of rows and iterations. The training writes a
.safetensors file for each chain, with the networks, the range of the chain's inputs, and the
provenance (package version, date, digest of the source). Systems that run on the robot do not
import this package.

Recipe `paper` (`PaperRecipe`): Table I of the paper (Pairet et al., RA-L 2019).

1. `lattice` rolls out the paper's lattice of 12.5 million motions on the action level (equations of
   motion) of the authors' released code (`released_law`); `paper` selects those with a clearance of
   at least 1 cm.
2. `paper` trains RC(lambda') and RC(lambda', Delta) and computes their errors, which `drake-oa
   train` prints beside the published ones.

Recipe `paper_running`: RC(lambda', Delta) on motions by this project's own equations of motion
(`lattice.running_paths`), as scenarios use it.

The networks are `torch.nn` modules of 24-24-24 tanh units (`networks`), fitted by
Levenberg-Marquardt (after Hagan and Menhaj 1994) with derivatives by `torch.func`, in float64 on
the CPU. The same seed gives the same weights on the same machine.

Results: docs/results/learning.md; choices with measurements: docs/theory/inference.md. Read `paper`
first.
"""
