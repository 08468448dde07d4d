"""Tests of the methods `paper` and `original`: action level, chain, temporal scaling."""

import math

import numpy as np
import pytest

from drake_oa.evaluation.scenes import paper_method
from drake_oa.evaluation.scenes.ground_truth import evaluate_motions
from drake_oa.evaluation.scenes.methods import Setting
from drake_oa.evaluation.scenes.scenes import make_scenes
from drake_oa.evaluation.scenes.suites import draw_scenes
from drake_oa.training import released_law
from drake_oa.training.released_law import STEPS, Steps, released_forcing

DEMO = Steps(500, 0.005)
"""Time steps of the released demonstration program."""


def test_forcing_term_equals_that_of_the_released_code(reference):
    data = np.load(reference("authors_action_level.npz"))
    expected = data["forcing"][:, :, 0] / data["baseline"][:, None]
    fitted = np.broadcast_to(released_forcing(DEMO), expected.shape)
    np.testing.assert_allclose(fitted, expected, atol=5e-9)


@pytest.mark.parametrize("name", ["trajectory", "trajectory_original_term"])
def test_trajectories_of_the_released_code_are_reproduced(reference, name, monkeypatch):
    data = np.load(reference("authors_action_level.npz"))
    monkeypatch.setattr(paper_method, "time_scale", lambda scenes: tau)
    for row in range(len(data["tau"])):
        # Forcing term and tau are those computed by the authors' code.
        i, tau = slice(row, row + 1), data["tau"][row : row + 1]
        forcing = data["forcing"][row, :, 0] / data["baseline"][row]
        monkeypatch.setattr(released_law, "released_forcing", lambda steps, f=forcing: f)
        scenes = make_scenes(data["baseline"][row], data["center"][i], data["semi_axes"][i])
        original = name != "trajectory"
        parameters = np.array([data[key][row] for key in ("alpha", "psi", "kappa")])
        if original:
            parameters = np.array((1000.0, 20.0 / math.pi, 0.0))
        motions = paper_method.released_motions(
            scenes, Setting(), parameters, original=original, steps=DEMO
        )
        np.testing.assert_allclose(motions.path[0, 1:501], data[name][row], atol=1e-9)


def test_tau_of_one_obstacle():
    scenes = make_scenes(1.0, [[0.5, 0.12, 0.0]], [[0.1, 0.2, 0.05]], clearance=0.15)
    way = 2.0 * math.hypot(0.5, 0.12) + 2.0 * (0.2 + 0.15)
    assert paper_method.time_scale(scenes)[0] == pytest.approx(way)


@pytest.mark.parametrize("constrained", [True, False])
def test_paper_method_ends_on_arrival_or_at_the_time_limit(constrained):
    chain = paper_method.paper_chain(paper_method.SHIPPED[not constrained])
    assert len(chain.lower) == 2 + constrained
    scenes, number = draw_scenes("novel", 40, seed=0), STEPS.number
    motions = paper_method.run(scenes, Setting(constrained=constrained))
    steps = motions.path.shape[1] - 1
    assert number <= steps <= 2 * number
    np.testing.assert_allclose(motions.duration, STEPS.length * steps)
    assert evaluate_motions(scenes, motions).collided.mean() < 0.1
    error = np.linalg.norm(motions.path - scenes.goal[:, None], axis=2)
    has_arrived = error[:, -1] <= paper_method.ARRIVED
    assert has_arrived.mean() > 0.4
    assert (error[~has_arrived, number:] > paper_method.ARRIVED).all()
