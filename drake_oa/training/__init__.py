"""Trains the networks that give or propose coupling parameters: `drake-oa train`.

In goes nothing but a recipe; out comes a .safetensors file that `regulation.regressor.load_chain`
reads: the three networks of `ChainWeights`, the range they were trained in, and where they come
from. Nothing here runs on the robot, and nothing that runs there imports it. Lengths are in
baselines L (semi-axes lambda1', lambda2' along and across, clearance Delta, place of the centre
along it), kappa in 1/L^2, psi in rad, alpha in 1/T; `paper` has metres and rad/s, on L = 1 m.

Recipe `proposals` (`ProposalRecipe`): the set network that leads the search of `!Verified`, trained
by `proposals` on what that search finds, round by round.

Recipe `project` (`Exploration` is its configuration): a chain that may lead it too.

1. `dataset` rolls out a grid of (kappa, psi, alpha) about one ellipse after another, chooses one
   for each ellipse and clearance, smooths the choices and solves for alpha. `rollouts` puts the
   scenes to the running system's own engine, `regulation.rollout`.
2. `chain` trains Y1 (kappa), Y2 (psi) and Y3 (alpha), each on the true values before it.
3. `validation` rolls out what the chain proposes in scenes that it was not trained on.

Recipe `paper` (`PaperRecipe`): Table I of the paper.

1. `released_method` rolls out the paper's lattice of 12.5 million motions as the authors' released
   code integrates them; `paper_set` keeps those that keep 1 cm, and tells what noise they hold.
2. `paper` trains RC(lambda') and RC(lambda', Delta), and puts the scores beside the printed ones.

Recipe `paper_running`: the same on the running system's action level (`rollouts.running_lattice`).

Recipe `confidence`: the module `confidence` rolls out what a chain of the running action level
proposes, inside and outside of its range, and fits the probability of keeping what is asked to
that. The chain's networks stay as they are; `paper_running` ends with it, too. (Proposals for the
search need none: each is rolled out.)

The chains' networks are `torch.nn` modules of 24-24-24 tanh units (`networks`), fitted by
Levenberg-Marquardt (`levenberg_marquardt`, after Hagan and Menhaj 1994) with derivatives by
`torch.func`, in float64, on the CPU or CUDA: the same seed gives the same weights on the same
machine. `checkpoint` keeps what was computed, so that an interrupted training goes on.

Results: docs/results/proposals.md, training_project.md, training_paper.md and uncertainty.md; the
choices, with measurements: docs/equations.md, "Regulation". Read `session` first, then `chain`.
"""
