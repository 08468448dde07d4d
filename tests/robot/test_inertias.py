"""Inertial parameters from a file; those of uniform density equal Drake's Panda."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from drake_oa.common.config import ScenarioError
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import make_robot_plant
from drake_oa.scenario.faults import ModelError


def test_uniform_density_equals_drakes_panda_and_has_the_known_errors(
    reference: Callable[[str], Path],
) -> None:
    plants = make_robot_plant(Robot()), make_robot_plant(Robot(), inertias=ModelError().inertias)
    expected = np.load(reference("panda_reference.npz"))
    mass_error, gravity_error = [], []
    contexts = [item.plant.CreateDefaultContext() for item in plants]
    for row, q in enumerate(expected["q"]):
        M, g = [], []
        for item, context in zip(plants, contexts, strict=True):
            item.plant.SetPositions(context, np.concatenate([q[:7], [0.0, 0.0]]))
            M.append(item.plant.CalcMassMatrix(context)[:7, :7])
            g.append(item.plant.CalcGravityGeneralizedForces(context)[:7])
        np.testing.assert_allclose(M[1], expected["M7_fingers_closed"][row], atol=1e-9)
        np.testing.assert_allclose(
            np.abs(g[1]), np.abs(expected["tau_g7_fingers_closed"][row]), atol=1e-9
        )
        rotors = np.diag(expected["reflected_inertia"][:7])
        mass_error.append(np.linalg.norm(M[1] - M[0]) / np.linalg.norm(M[0] - rotors))
        gravity_error.append(np.abs(g[1] - g[0]).max())
    assert 0.03 < np.mean(mass_error) < 0.06
    assert 1.8 < np.max(gravity_error) < 2.1


def test_error_of_an_invalid_file_names_the_file(tmp_path: Path) -> None:
    file = tmp_path / "inertias.yaml"
    values = "{mass: 1, com: [0, 0, 0], inertia: [1, 1, 1, 0, 0, 0]}"
    for content, message in (
        (None, "does not exist"),
        ("panda_link0: {mass: 1}", r"inertias\.panda_link0\.com: is missing"),
        (f"base: {values}", r"robot\.model has no link base; it has panda_link0"),
    ):
        if content is not None:
            file.write_text(content)
        with pytest.raises(ScenarioError, match=rf"(?s)!ModelError\.inertias: .*{file}.*{message}"):
            make_robot_plant(Robot(), inertias=str(file))
