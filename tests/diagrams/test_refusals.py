"""Tests of the errors for scenarios that cannot run, which name the field."""

from pathlib import Path

import numpy as np
import pytest

from drake_oa.common.config import ScenarioError
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario

BOX = "tabletop_box"
GIVEN = ["perception=!GivenEllipsoids {ellipsoids: []}", "inference=!Verified {}"]
UNSEEN = ["cameras=[]", "perception=!GroundTruth {}"]
MODEL = "directives=[{{add_model: {{name: obstacle_a, file: package://drake_oa/{}.sdf}}}}]"
PAPER = "inference.weights=package://drake_oa/weights/paper_chain.safetensors"


@pytest.mark.parametrize(
    ("name", "overrides", "words"),
    [
        (BOX, ["task.goal=[0.45, -0.45, 0.3]"], ["task.goal", "1 mm apart"]),
        (BOX, ["task.goal=[2.0, 0.0, 0.3]"], ["task.goal", "out of reach"]),
        (BOX, ["task.start=[0.45, -0.45, 1.9]"], ["task.start", "out of reach"]),
        (BOX, ["task.goal_moves=[[2, 1.5, 0, 0.3]]"], ["task.goal_moves[0]: "]),
        (BOX, ["perception=!RecordedClouds {folder: /a}"], ["perception.folder", "/a"]),
        (BOX, ["task.demonstration=/no.npz"], ["task.demonstration", "/no.npz"]),
        (BOX, ["inference.chain=/no.npz"], ["inference.chain: "]),
        (BOX, GIVEN, ["!Verified requires the collision geometry"]),
        (BOX, ["faults=[!Push {body: tail}]"], ["faults[0].body: ", "no link 'tail'"]),
        (BOX, ["robot.tool_links=[panda_thumb]"], ["robot.tool_links", "panda_thumb"]),
        (BOX, ["robot.tool_links=[panda_link8]"], ["robot.tool_links", "panda_link8"]),
        (BOX, ["robot.tool_links=[panda_link0]"], ["robot.tool_links", "panda_leftfinger"]),
        (BOX, ["robot.tool_links=[]"], ["robot.tool_links"]),
        (BOX, ["robot.q_seed=[0, 0, 0, 0, 0, 1, 0]"], ["robot.q_seed", "panda_joint4", "-3.0"]),
        (BOX, ["robot.model=package://no/robot.urdf"], ["robot.model", "no/robot.urdf"]),
        (BOX, ["robot.base_link=base"], ["robot.base_link", "'base'", "panda_link0"]),
        (BOX, ["robot.hand_link=palm"], ["robot.hand_link", "'palm'", "panda_hand"]),
        (BOX, [*UNSEEN, MODEL.format("obstacles/cardboard_box")], ["directives", "can move"]),
        (BOX, [MODEL.format("no")], ["directives", "no.sdf"]),
        (BOX, ["obstacles=[{name: box, shapes: [!Sphere {}]}]"], ["obstacle_box"]),
        (BOX, ["cameras=[{name: camera, output_delay: 0.5}]"], ["camera 'camera'"]),
        ("free_space", [PAPER], ["inference.weights: ", "rad/s", "paper_running"]),
    ],
)
def test_invalid_scenario_is_rejected_with_its_field(
    name: str, overrides: list[str], words: list[str]
) -> None:
    with pytest.raises(ScenarioError) as error:
        build_avoidance(load_scenario(name, overrides))
    for word in words:
        assert word in str(error.value)


def test_recording_requires_the_pose_of_its_camera(recording_folder: Path, tmp_path: Path) -> None:
    with np.load(recording_folder / "cloud_0.000.npz") as archive:
        np.savez(tmp_path / "cloud.npz", points=archive["points"])

    def overrides(pose: str = "") -> list[str]:
        return [f"perception=!RecordedClouds {{folder: {tmp_path}{pose}}}"]

    for pose, field in (("", "X_WC"), (", X_WC: {base_frame: lamp}", "X_WC.base_frame")):
        with pytest.raises(ScenarioError, match=rf"perception\.{field}: "):
            build_avoidance(load_scenario("tabletop_box", overrides(pose)))
    pose = ", X_WC: {translation: [0.05, 0, 0]}"
    log = simulate(load_scenario("tabletop_box", overrides(pose)), duration=0.1)
    np.testing.assert_allclose(log.p_WO[0, 0, :2], [0.5, 0.0], atol=0.03)
    assert np.isfinite(log.torque).all()
