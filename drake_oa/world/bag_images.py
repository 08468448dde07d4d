"""Depth images in bags of ROS 2 messages (rosbag2): recorder, reader, and camera that replays."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain, islice, zip_longest
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, LeafSystem
from pydrake.systems.sensors import CameraConfig, CameraInfo, ImageDepth32F

from drake_oa.common.bags import SECOND, WORLD, BagWriter, header, quaternion, typestore, vector
from drake_oa.common.config import ScenarioError, field_errors
from drake_oa.common.files import import_extra
from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.common.ports import AbstractInput
from drake_oa.perception.config import RecordedBag
from drake_oa.perception.depth_perception import first_update
from drake_oa.perception.recordings import checked_intrinsics
from drake_oa.robot.plant import TOOL_FRAME
from drake_oa.scenario.sources import fixed_transform
from drake_oa.world.cameras import PIXEL_CENTER, TimedCamera, depth_intrinsics
from drake_oa.world.depth_messages import metric_depth
from drake_oa.world.live_camera import fixed_pose

_ENCODINGS = {"16UC1": "u2", "32FC1": "f4"}
"""NumPy types of the depths by encoding of a sensor_msgs/Image: 16UC1 [mm], 32FC1 [m]."""
_ROUNDING = 1e-9
"""Tolerance for the rounding of times and poses in a bag.

Two times count as equal up to this difference [s], and two poses if each element of their rotation
matrices [-] and positions [m] differs by at most this."""


class ImageRecorder(LeafSystem):
    """Recorder of the depth images of a camera, with intrinsics, pose and joint states.

    .. pydrake_system::

      name: ImageRecorder
      input_ports:
      - depth_image
      - camera_pose
      - image_stamp
      - plant_state_at_image

    - depth_image: ImageDepth32F along the optical axis [m]; 0 is too near, inf is too far, NaN is
      missing. Written as 32FC1 on /<camera>/depth/image_rect_raw, where -inf is too near.
    - camera_pose: RigidTransform X_WC of the camera. Written on /tf when it has changed.
    - image_stamp: (1,) time of the image [s], the stamp of the messages.
    - plant_state_at_image: (n,) state [q, v] of the plant at that time. The positions and
      velocities of the robot's joints are written on /joint_states.

    The intrinsics are written on /<camera>/depth/camera_info. The messages are written at
    initialization, and at the times at which the system `DepthPerception` reads the image: once per
    period of the camera, when the image has arrived. Before the first image nothing is written.
    """

    def __init__(self, bag: BagWriter, config: CameraConfig, plant: MultibodyPlant) -> None:
        """Declares the ports and events.

        Args:
            bag: bag to which the messages are written.
            config: configuration of the camera. The camera's name is also the name of its frame and
                the first part of its topics.
            plant: finalized plant with the robot.
        """
        super().__init__()
        self._bag, self._name = bag, config.name
        self._joints, self._rows = robot_rows(plant)
        K = depth_intrinsics(config).intrinsic_matrix()
        # In ROS the center of the first pixel is at 0.
        K[:2, 2] -= PIXEL_CENTER
        # Like the position in the file, the last pose belongs to the bag, not to the Context.
        self._last_pose: RigidTransform | None = None
        matrices = {"k": K, "r": np.eye(3), "p": K @ np.eye(3, 4)}
        self._matrices = {name: matrix.ravel().tolist() for name, matrix in matrices.items()}
        self._image = AbstractInput(self, "depth_image", ImageDepth32F)
        self._pose = AbstractInput(self, "camera_pose", RigidTransform)
        self._stamp = self.DeclareVectorInputPort("image_stamp", 1)
        num_states = plant.num_multibody_states()
        self._state = self.DeclareVectorInputPort("plant_state_at_image", num_states)
        self.DeclareInitializationPublishEvent(self._write)
        period = 1.0 / config.fps
        offset = first_update(period, config.output_delay)
        self.DeclarePeriodicPublishEvent(period, offset, self._write)

    def _write(self, context: Context) -> None:
        """Writes the image at the input port, with its camera pose, intrinsics and joint states, to
        the bag; nothing before the first image.
        """
        (stamp,) = self._stamp.Eval(context)
        if not np.isfinite(stamp):
            return
        write, topic, frame = self._bag.write, f"/{self._name}/depth", self._name
        X_WC, depth = self._pose.read(context), np.array(self._image.read(context).data)
        q, v = self._state.Eval(context)[self._rows].reshape(2, -1).tolist()
        kind = "sensor_msgs/msg/JointState"
        write("/joint_states", kind, stamp, name=self._joints, position=q, velocity=v)
        if self._last_pose is None or not X_WC.IsExactlyEqualTo(self._last_pose):
            self._last_pose = X_WC
            p_WC, q_WC = vector(X_WC.translation()), quaternion(X_WC.rotation())
            pose = {"translation": p_WC, "rotation": q_WC}
            item = {"header": header(stamp), "child_frame_id": frame, "transform": pose}
            write("/tf", "tf2_msgs/msg/TFMessage", stamp, transforms=[item])
        depth[depth == 0.0] = -np.inf
        size = {"height": len(depth), "width": depth.shape[1]}
        kind = "sensor_msgs/msg/CameraInfo"
        write(f"{topic}/camera_info", kind, stamp, frame, **size, **self._matrices)
        image = {"encoding": "32FC1", "step": depth.strides[0], "data": depth.tobytes()}
        write(f"{topic}/image_rect_raw", "sensor_msgs/msg/Image", stamp, frame, **size, **image)


def robot_rows(plant: MultibodyPlant) -> tuple[list[str], IntArray]:
    """Returns the names of the robot's n joints, and their rows in the state [q, v] of the plant.

    The joints have one degree of freedom.

    Args:
        plant: finalized plant with the robot, which is the model instance of the tool frame
            (`TOOL_FRAME`).

    Returns:
        List of n joint names, and (2 n,) indices in the state of the plant, of the positions of the
        joints and then of their velocities.
    """
    robot = plant.GetFrameByName(TOOL_FRAME).model_instance()
    q, v = np.split(np.arange(plant.num_multibody_states()), [plant.num_positions()])
    rows = [*plant.GetPositionsFromArray(robot, q), *plant.GetVelocitiesFromArray(robot, v)]
    return plant.GetPositionNames(robot, always_add_suffix=False), np.array(rows, int)


class BagFrame(NamedTuple):
    """Depth image of a bag, with the state of the robot and the pose of the camera.

    Attributes:
        time: stamp of the image minus the stamp of the first image of the bag [s].
        depth: (H, W) depths along the optical axis [m]; 0 is too near, inf is too far, NaN is
            missing.
        intrinsics: intrinsics of the image [pixel], for image coordinates in which the center of
            the first pixel is at 0.5 (`PIXEL_CENTER`).
        X_WC: pose of the camera (x right, y down, z forward) in the world.
        state: (2 n,) positions and velocities of n robot joints at the stamp of the image [rad, m,
            rad/s, m/s]; NaN: unknown.
    """

    time: float
    depth: NDArray[np.float32]
    intrinsics: CameraInfo
    X_WC: RigidTransform
    state: FloatArray


def read_frames(
    source: RecordedBag, joints: Sequence[str], period: float
) -> Generator[BagFrame, None, None]:
    """Reads the depth images of a bag in the order of time, one at a time.

    The pose of the camera and the state of the joints are from the latest messages that precede the
    image in the bag; the first joint message also serves images before it. The positions of the
    joints are extrapolated to the stamp of the image with their velocities.

    Args:
        source: perception block with the path of the bag, its topics and the pose of the camera.
        joints: names of n robot joints.
        period: time between two images of the camera, if it was simulated [s]. A time within a
            nanosecond of a multiple of the period is replaced by the exact multiple.

    Raises:
        ScenarioError: for a bag that cannot be read, a topic that is missing or has another type,
            an image of another encoding than 16UC1 and 32FC1 or of another size than in the camera
            info, a stamp that goes backward, or an image without a camera pose.
    """
    with field_errors("perception", ValueError):
        rosbag2 = import_extra("rosbags.rosbag2", "bags")
    try:
        with rosbag2.Reader(source.path) as reader:
            _check_topics(reader, source)
            yield from _frames(reader, source, joints, period)
    except ScenarioError:
        raise
    except Exception as error:  # Damaged data raise exceptions of several types.
        raise ScenarioError(
            f"perception.path: '{source.path}' cannot be read: {error}; valid is a complete bag of "
            "ROS 2, a folder with metadata.yaml, a .mcap or a .db3 file"
        ) from error


def _check_topics(reader: Any, source: RecordedBag) -> None:
    """Checks that an open bag has messages of the required types.

    Args:
        reader: reader of rosbags for the open bag.
        source: perception block with the topics.

    Raises:
        ScenarioError: naming all topics without messages or with messages of another type.
    """
    kinds = {one.topic: one.msgtype for one in reader.connections if one.msgcount}
    required = {"depth_topic": "Image", "info_topic": "CameraInfo", "joint_topic": "JointState"}
    problems = [
        f"perception.{field}: {topic} has {kinds.get(topic, 'no messages')}, not "
        f"sensor_msgs/msg/{kind}; the bag has {', '.join(sorted(kinds)) or 'no topics'}"
        for field, kind in required.items()
        if (topic := getattr(source, field)) and kinds.get(topic) != f"sensor_msgs/msg/{kind}"
    ]
    if problems:
        raise ScenarioError(*problems)


def _frames(
    reader: Any, source: RecordedBag, joints: Sequence[str], period: float
) -> Iterator[BagFrame]:
    """Yields each depth image of an open bag, with pose and joint state, in the order of time.

    Args:
        reader: reader of rosbags for the open bag.
        source: perception block with the topics of the bag and the pose of the camera.
        joints: names of n robot joints.
        period: time between two images of the camera, if it was simulated [s].

    Raises:
        ScenarioError: for an image of another encoding than 16UC1 and 32FC1 or of another size than
            in the camera info, a stamp that goes backward, or an image without a camera pose.
    """

    def messages(*topics: str | None) -> Iterator[tuple[str, Any]]:
        """Yields topic and message of all messages on the given topics, in the order of the bag;
        None is no topic.
        """
        connections = [one for one in reader.connections if one.topic in topics]
        for connection, _, data in reader.messages(connections) if connections else ():
            yield connection.topic, typestore().deserialize_cdr(data, connection.msgtype)

    _, info = next(messages(source.info_topic))
    K = checked_intrinsics(info.k, source.info_topic) + [0.0, 0.0, PIXEL_CENTER, PIXEL_CENTER]
    intrinsics = CameraInfo(info.width, info.height, *K)
    given = fixed_transform(source.camera_pose, "perception.camera_pose")
    transforms: dict[str, Any] = {}
    stamps: dict[str, int] = {}
    states: dict[str, Any] = {}
    start: int | None = None
    # The first image may precede all states.
    first = chain(messages("/tf_static"), islice(messages(source.joint_topic), 1))
    for topic, message in chain(first, messages(source.depth_topic, source.joint_topic, "/tf")):
        if topic.startswith("/tf"):
            transforms |= {item.child_frame_id: item for item in message.transforms}
            continue
        stamp = message.header.stamp.sec * SECOND + message.header.stamp.nanosec
        if stamp < stamps.get(topic, stamp):
            raise ScenarioError(
                f"perception.path: stamps on {topic} go backward, from {stamps[topic]} to {stamp} "
                "ns; record one publisher without restarting it"
            )
        stamps[topic] = stamp
        if topic == source.joint_topic:
            # A message may name only some joints; velocities are optional.
            values = zip_longest(message.position, message.velocity, fillvalue=0.0)
            states |= zip(message.name, values, strict=True)
            continue
        start = stamp if start is None else start
        q, v = np.transpose([states.get(joint, [np.nan, np.nan]) for joint in joints])
        q = q + (stamp - stamps.get(source.joint_topic or "", stamp)) / SECOND * v
        X_WC = given or _pose(transforms, message.header.frame_id)
        depth = _depth(message, source, intrinsics)
        time = _exact_time((stamp - start) / SECOND, period)
        yield BagFrame(time, depth, intrinsics, X_WC, np.concatenate([q, v]))


def _exact_time(time: float, period: float) -> float:
    """Replaces a time that is a multiple of a period up to rounding by the exact multiple.

    Args:
        time: time [s].
        period: period of a simulated camera [s].

    Returns:
        Time of the periodic event of Drake that is within 1 ns of `time`; if there is none, `time`.
    """
    count = round(time / period)
    # The k-th event of a periodic system is at this sum, which is rounded otherwise than k T.
    exact = period + (count - 1) * period if count else 0.0
    return exact if abs(exact - time) < _ROUNDING else time


def _depth(message: Any, source: RecordedBag, intrinsics: CameraInfo) -> NDArray[np.float32]:
    """Returns the depths (H, W) of an image message [m]; 0: too near, inf: too far, NaN: missing.

    Args:
        message: sensor_msgs/Image of encoding 16UC1 [mm] or 32FC1 [m]. In the message 0 or NaN is
            missing, -inf is too near, and 65535 mm or inf is too far.
        source: perception block with the topics, for the error.
        intrinsics: intrinsics of the image, with its required size.

    Raises:
        ScenarioError: for another encoding or size.
    """
    height, width, encoding = message.height, message.width, message.encoding
    size = intrinsics.width(), intrinsics.height()
    if encoding not in _ENCODINGS or (width, height) != size:
        raise ScenarioError(
            f"perception.depth_topic: images on {source.depth_topic} are {width} x {height} "
            f"{encoding}; valid are {' and '.join(_ENCODINGS)} of {size[0]} x {size[1]} pixels, "
            f"the size on {source.info_topic}"
        )
    kind = np.dtype(_ENCODINGS[encoding]).newbyteorder(">" if message.is_bigendian else "<")
    rows = message.data.reshape(height, message.step)
    depth = rows[:, : width * kind.itemsize].view(kind)
    # An image in which every pixel is measured or NaN is used without a copy.
    if kind.kind == "u" or (depth <= 0.0).any():
        depth = metric_depth(depth)
        depth[depth < 0.0] = 0.0
    return depth


def _pose(transforms: Mapping[str, Any], frame: str) -> RigidTransform:
    """Returns the pose of a frame in the world frame of the bag, "world".

    Args:
        transforms: geometry_msgs/TransformStamped of each frame relative to its parent frame, by
            the name of the (child) frame.
        frame: name of the frame.

    Raises:
        ScenarioError: if the transforms do not connect the frame to the world.
    """
    X, child, remaining = RigidTransform(), frame, dict(transforms)
    while child in remaining:
        item = remaining.pop(child)
        p, q = item.transform.translation, item.transform.rotation
        wxyz = np.array([q.w, q.x, q.y, q.z])
        R_PC = Quaternion(wxyz / np.linalg.norm(wxyz))
        child, X = item.header.frame_id, RigidTransform(R_PC, [p.x, p.y, p.z]) @ X
    if child != WORLD:
        raise ScenarioError(
            f"perception.camera_pose: must be set, because the bag has no transform from '{WORLD}' "
            f"to '{frame}', the frame of the images: 'camera_pose: {{translation: [x, y, z], "
            "rotation: !Rpy {deg: [r, p, y]}}'"
        )
    return X


class BagCamera(TimedCamera):
    """System that replays the images of a depth camera from a bag at their own stamps.

    .. pydrake_system::

      name: BagCamera
      input_ports:
      - plant_state
      output_ports:
      - depth_image
      - camera_pose
      - image_time
      - plant_state

    - plant_state (in): (n,) present state [q, v] of the simulated plant.
    - depth_image: ImageDepth32F along the optical axis [m]; 0 is too near, inf is too far, NaN is
      missing.
    - camera_pose: RigidTransform X_WC of the camera at the stamp of the image: the field
      `camera_pose` of the perception block, or the pose in the bag if this field is null.
    - image_time: (1,) stamp of the image minus the stamp of the first image [s].
    - plant_state (out): (n,) present state [q, v] of the simulated plant, except that robot joints
      with a state in the bag have the recorded state at the stamp of the image.

    Which image is output depends only on time. The first image is output from time 0 on, and each
    other image from its `image_time` plus the delay that the scenario sets for the camera. The last
    image remains.

    In a bag, times are rounded to nanoseconds, and rotations to quaternions. Therefore an
    `image_time` within 1 ns of a multiple of the camera's period is replaced by the time of Drake's
    periodic event at this multiple. A pose whose
    matrix elements and coordinates [m] are within 1e-9 of the pose that the scenario sets for the
    camera is replaced by the latter. The recorded images of a simulated camera thus give
    bit-identical observations.
    """

    def __init__(self, source: RecordedBag, config: CameraConfig, plant: MultibodyPlant) -> None:
        """Reads the first image, and declares the ports.

        Args:
            source: perception block with path and topics of the bag and the pose of the camera.
            config: camera of the scenario with its frame rate, delay and pose.
            plant: finalized plant with the robot.

        Raises:
            ScenarioError: if the bag cannot be read, lacks a topic or a pose of the camera, has no
                joint of the robot, or if the camera of the scenario can move.
        """
        joints, self._rows = robot_rows(plant)
        period = 1.0 / config.fps
        self._open = partial(read_frames, source, joints, period)
        self._restart()
        if source.joint_topic and np.isnan(self._frame.state).all():
            raise ScenarioError(
                f"perception.joint_topic: {source.joint_topic} has no joint of the robot before "
                f"the first image: {', '.join(joints)}; null: the robot is in its simulated state"
            )
        super().__init__(self._frame.intrinsics, plant.num_multibody_states(), None)
        self._delay, self._exact = config.output_delay, fixed_pose(plant, config)
        # Steps of the simulation end at the times of images, as with a simulated camera, so that
        # monitors are evaluated at the same times.
        self.DeclarePeriodicPublishEvent(period, period, lambda context: None)

    def _restart(self) -> None:
        """Opens the bag and reads its first two images."""
        self._frames = self._open()
        self._frame, self._next = next(self._frames), next(self._frames, None)

    def release(self) -> None:
        """Closes the bag; the next image opens it again."""
        self._frames.close()
        self._frame = self._frame._replace(time=np.inf)

    def _read(self, context: Context) -> BagFrame:
        """Returns the image that the camera outputs at the time of a Context, with its time, pose
        and joint state.

        The bag is read up to this image, again from its start if a later image was read before.
        """
        latest = context.get_time() - self._delay + _ROUNDING
        if self._frame.time > max(latest, 0.0):
            self._restart()
        while self._next is not None and self._next.time <= latest:
            self._frame, self._next = self._next, next(self._frames, None)
        return self._frame

    def image(self, context: Context) -> NDArray[np.float32] | float:
        """Returns the depths (H, W) along the optical axis [m] of the image that the camera outputs
        at the time of a Context.
        """
        return self._read(context).depth

    def pose(self, context: Context) -> RigidTransform:
        """Returns the pose X_WC of the camera at the stamp of the image that it outputs at the time
        of a Context.
        """
        X_WC = self._read(context).X_WC
        return self._exact if X_WC.IsNearlyEqualTo(self._exact, _ROUNDING) else X_WC

    def capture_state(self, context: Context) -> tuple[float, FloatArray]:
        """Returns the stamp of the image that the camera outputs at the time of a Context, minus
        the stamp of the first image [s], and the plant state (n,).

        In this state, robot joints in the bag have their recorded state at the stamp of the image;
        the rest is the present state of the simulated plant.
        """
        frame, state = self._read(context), np.array(self._state_port.Eval(context))
        is_known = np.isfinite(frame.state)
        state[self._rows[is_known]] = frame.state[is_known]
        return frame.time, state
