"""Bags of ROS 2 messages: written by a run, read by a foreign reader, replayed, refused."""

import contextlib
import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drake_oa.common.bags import BagWriter, header, new_bag, typestore
from drake_oa.common.config import ScenarioError
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.diagrams.perception import record_images
from drake_oa.perception.config import RecordedBag
from drake_oa.runs.bag_log import write_log
from drake_oa.runs.motion_log import MotionLog, save_logs
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario
from drake_oa.world.bag_images import read_frames
from tests.builders import command
from tests.test_systems import checked_systems

rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="pip install 'drake_oa[bags]'")

DURATION = 0.25
IMAGE, INFO = "/camera/depth/image_rect_raw", "/camera/depth/camera_info"
K = [4.0, 0.0, 1.0, 0.0, 4.0, 0.5, 0.0, 0.0, 1.0]
DEPTH = np.array([[0, 1500, 65535], [800, 900, 1000]], np.uint16)
POSE = ", camera_pose: {translation: [0.0, 0.0, 1.0]}"


def box(*overrides: str) -> Scenario:
    """Returns the scenario of the box with small images."""
    scenario = load_scenario("tabletop_box", overrides)
    scenario.cameras[0].width, scenario.cameras[0].height = 160, 120
    return scenario


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, MotionLog]:
    """Bag and log of the beginning of a motion."""
    file, scenario = tmp_path_factory.mktemp("bag") / "box.mcap", box()
    with new_bag(file) as bag:
        diagram = build_avoidance(scenario, customize=partial(record_images, bag, scenario))
        assert "ImageRecorder" in checked_systems(diagram)
        log = simulate(scenario, duration=DURATION, diagram=diagram)
        write_log(bag, scenario, log)
    return file, log


def test_bag_gives_the_decisions_of_its_run_to_the_last_bit(run: tuple[Path, MotionLog]) -> None:
    file, log = run
    scenario = box(f"perception=!RecordedBag {{path: {file}}}")
    diagram = build_avoidance(scenario)
    assert "BagCamera" in checked_systems(diagram)
    expected = log.arrays()
    # The second run reads the bag again.
    for _ in range(2):
        replayed = simulate(scenario, duration=DURATION, diagram=diagram).arrays()
        for key in expected.keys() - {"scenario", "wall_time"}:
            np.testing.assert_array_equal(replayed[key], expected[key], key)
    assert len(log.observation_stamp) > 5
    assert (log.motion_source >= 0.0).any()


def test_bag_opens_in_a_foreign_reader(run: tuple[Path, MotionLog]) -> None:
    reader, decoder = pytest.importorskip("mcap.reader"), pytest.importorskip("mcap_ros2.decoder")
    file, log = run
    messages: dict[str, list[Any]] = {}
    with file.open("rb") as stream:
        bag = reader.make_reader(stream, decoder_factories=[decoder.DecoderFactory()])
        for _, channel, _, message in bag.iter_decoded_messages():
            messages.setdefault(channel.topic, []).append(message)
    image, info = messages[IMAGE][0], messages[INFO][0]
    depth = np.frombuffer(bytes(image.data), np.float32).reshape(120, 160)
    assert (image.encoding, info.width, info.k[2]) == ("32FC1", 160, 79.0)
    assert 0.8 < np.nanmedian(depth) < 3.5
    assert messages["/tf"][0].transforms[0].child_frame_id == image.header.frame_id
    assert list(messages["/joint_states"][0].name) == list(log.position_name)
    assert [m.data for m in messages["/log/phase"]] == log.phase.tolist()
    assert list(messages["/log/desired_velocity"][-1].data) == log.desired_velocity[-1].tolist()
    assert min(m.data for m in messages["/tool_clearance"]) > 0.0
    ids = log.observation(-1).ids.tolist()
    assert [m.id for m in messages["/obstacles"]][-len(ids) :] == ids
    assert {m.msg for m in messages["/rosout"]} >= {"verification", "guard"}
    text = messages["/log/constants"][0].data
    assert json.loads(text, parse_constant=pytest.fail)["seed"] == log.seed


def write_frame(bag: BagWriter, time: float, **changes: Any) -> None:
    """Writes a depth image of 16 bit with its camera info."""
    size = {"height": 2, "width": 3}
    bag.write(INFO, "sensor_msgs/msg/CameraInfo", time, "eye", **size, k=K)
    image = {"encoding": "16UC1", "step": 6, "data": DEPTH.tobytes()}
    bag.write(IMAGE, "sensor_msgs/msg/Image", time, "eye", **(size | image | changes))


def write_state(bag: BagWriter, time: float, joint: str, q: float, *v: float) -> None:
    """Writes the state of one joint."""
    kind = "sensor_msgs/msg/JointState"
    bag.write("/joint_states", kind, time, name=[joint], position=[q], velocity=list(v))


def convert(mcap: Path, folder: Path) -> None:
    """Copies a bag to a folder with an sqlite3 file."""
    with rosbag2.Reader(mcap) as reader, rosbag2.Writer(folder, version=9) as writer:
        for of in reader.connections:
            topic = writer.add_connection(of.topic, of.msgtype, typestore=typestore())
            for _, stamp, data in reader.messages([of]):
                writer.write(topic, stamp, data)


@pytest.mark.parametrize("name", ["bag.mcap", "sqlite"])
def test_bag_of_a_driver_gives_depths_states_and_poses(name: str, tmp_path: Path) -> None:
    with new_bag(tmp_path / "bag.mcap") as bag:
        for parent, child in (("mount", "eye"), ("world", "mount")):
            turn = {"translation": {"x": 1.0}, "rotation": {"z": 1.0, "w": 1.0}}
            item = {"header": {"frame_id": parent}, "child_frame_id": child, "transform": turn}
            bag.write("/tf_static", "tf2_msgs/msg/TFMessage", 5.0, transforms=[item])
        write_frame(bag, 5.0)
        write_state(bag, 5.0, "a", 1.0, 0.5)
        write_state(bag, 5.02, "b", 2.0)
        write_frame(bag, 5.04)
    convert(tmp_path / "bag.mcap", tmp_path / "sqlite")
    frames = list(read_frames(RecordedBag(path=str(tmp_path / name)), ["a", "b", "c"], 1.0))
    assert [frame.time for frame in frames] == pytest.approx([0.0, 0.04])
    np.testing.assert_allclose(frames[0].depth, [[np.nan, 1.5, np.inf], [0.8, 0.9, 1.0]])
    # Two turns of 90 degrees about z.
    np.testing.assert_allclose(frames[0].X_WC.translation(), [1.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(frames[1].state, [1.01, 2.0, np.nan, 0.5, 0.0, np.nan])


def write_backward(bag: BagWriter) -> None:
    """Writes two depth images, of which the second one was taken first."""
    write_frame(bag, 1.0)
    write_frame(bag, 1.1, header=header(0.9))


ERRORS: dict[str, tuple[str, Callable[[BagWriter], None], str]] = {
    "topics": (
        "",
        lambda bag: bag.write("/clock", "std_msgs/msg/Header", 1.0),
        r"depth_topic: /camera/\S+ has no messages, not .*Image.*(?s:.*)joint_topic: .* /clock",
    ),
    "backward": (POSE, write_backward, "go backward, from 1000000000 to 9"),
    "size": (POSE, lambda bag: write_frame(bag, 1.0, width=2), "are 2 x 2 16UC1; .* of 3 x 2"),
    "encoding": (POSE, lambda bag: write_frame(bag, 1.0, encoding="rgb8"), "rgb8; valid are 16UC1"),
    "cut": (POSE, lambda bag: write_frame(bag, 1.0, data=bytes(4)), "cannot be read"),
    "pose": ("", lambda bag: write_frame(bag, 1.0), "camera_pose: must be set.*'world' to 'eye'"),
}


@pytest.mark.parametrize("name", ERRORS)
def test_bag_with_wrong_messages_is_refused(name: str, tmp_path: Path) -> None:
    field, write, error = ERRORS[name]
    with new_bag(tmp_path / "a.mcap") as bag:
        write(bag)
    fields = f"path: {tmp_path}/a.mcap{field}" + ", joint_topic: null" * (name != "topics")
    source = load_scenario("tabletop_box", [f"perception=!RecordedBag {{{fields}}}"]).perception
    with pytest.raises(ScenarioError, match=error):
        list(read_frames(source, ["a"], 1.0))


def test_bag_is_complete_until_an_interruption(tmp_path: Path) -> None:
    with contextlib.suppress(KeyboardInterrupt), new_bag(tmp_path / "a.mcap") as bag:
        write_frame(bag, 1.0)
        raise KeyboardInterrupt
    with rosbag2.Reader(tmp_path / "a.mcap") as reader:
        assert reader.message_count == 2


def test_bag_of_another_robot_is_refused(tmp_path: Path) -> None:
    with new_bag(tmp_path / "a.mcap") as bag:
        write_state(bag, 1.0, "elbow", 0.0)
        write_frame(bag, 1.0)
    with pytest.raises(ScenarioError, match=r"joint_topic: .* panda_joint1, .*null"):
        build_avoidance(box(f"perception=!RecordedBag {{path: {tmp_path}/a.mcap{POSE}}}"))


def test_bag_that_is_damaged_or_foreign_is_refused(
    run: tuple[Path, MotionLog], tmp_path: Path
) -> None:
    data = run[0].read_bytes()
    for name, content in {
        "cut.mcap": data[:-100],
        "a.db3": b"x" * 5000,
        "a.bag": b"#ROSBAG",
    }.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ScenarioError, match=f"path: '.*{name}' cannot be read: .*; valid"):
            next(read_frames(RecordedBag(path=str(tmp_path / name)), [], 1.0))


def test_bag_commands(
    run: tuple[Path, MotionLog],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    log, bag = tmp_path / "log.npz", tmp_path / "log.mcap"
    save_logs(log, {"avoiding": run[1]})
    assert command("export", log, bag) == 0
    truth = ("--set", "perception=!GroundTruth {}", "--no-log", "--duration", 0.05)
    assert command("run", "tabletop_box", *truth, "--write-bag", tmp_path / "run.mcap") == 0
    for file in (bag, tmp_path / "run.mcap"):
        with rosbag2.Reader(file) as reader:
            assert {"/log/q", "/robot_clearance"} <= reader.topics.keys()
            assert IMAGE not in reader.topics
    assert command("run", "tabletop_box", "--hardware", "lcm", "--write-bag", bag) == 2
    stored = bag.read_bytes()
    wrong = ("--set", "faults=[!Push {body: tail}]", "--no-log", "--write-bag", bag)
    assert command("run", "tabletop_box", *wrong) == 2
    assert bag.read_bytes() == stored
    monkeypatch.setitem(sys.modules, "mcap_ros2.writer", None)
    assert command("export", log, bag) == 2
    error = capsys.readouterr().err
    assert "exclude each other" in error
    assert "pip install 'drake_oa[bags]'" in error
