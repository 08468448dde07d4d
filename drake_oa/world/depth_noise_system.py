"""Between a simulated depth camera and perception: the noise of a real one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, LeafSystem, ValueProducer
from pydrake.systems.sensors import CameraInfo, ImageDepth32F

from drake_oa.common.ports import read_value
from drake_oa.geometry.pinhole import pinhole
from drake_oa.scenario.camera_noise import DepthNoiseParameters
from drake_oa.world.depth_noise import FrameNoise, NoiseRoom


class DepthNoise(LeafSystem):
    """Makes of a rendered depth image what a structured-light camera would have told.

    .. pydrake_system::

      name: DepthNoise
      input_ports:
      - depth_image
      output_ports:
      - depth_image

    Input port `depth_image`: ImageDepth32F, true depth along the optical axis [m]; 0 is
    too near, inf too far, NaN missing.

    Output port `depth_image`: ImageDepth32F, measured depth [m]; NaN is missing, for
    whatever reason.

    The model, its parameters and their sources are
    `drake_oa.world.depth_noise.DepthNoiseParameters`. Nothing is kept: the noise is a function of
    the seed, the Context's time in whole microseconds, and the image. The output is computed when
    it is asked for, so that the camera renders as often as without this system.
    """

    def __init__(
        self,
        camera: CameraInfo | Sequence[float],
        *,
        parameters: DepthNoiseParameters | None = None,
        seed: int = 0,
    ) -> None:
        """Declares the ports.

        Args:
            camera: the depth camera's intrinsics, or [fx, fy, cx, cy] [pixel].
            parameters: of the noise; None for the defaults.
            seed: of the noise.

        Raises:
            ValueError: for invalid intrinsics or a negative seed.
        """
        super().__init__()
        width, height = 1, 1
        if isinstance(camera, CameraInfo):
            width, height = camera.width(), camera.height()
            camera = pinhole(camera)
        self._noise = FrameNoise(camera, parameters, seed=seed)
        # Kept in the Context: its memory is not asked for anew with each image.
        self._room = self.DeclareCacheEntry(
            "room for the noise to work in",
            ValueProducer(
                allocate=lambda: Value(NoiseRoom(height, width)), calc=ValueProducer.NoopCalc
            ),
            prerequisites_of_calc={self.nothing_ticket()},
        )
        self._image_port = self.DeclareAbstractInputPort("depth_image", Value(ImageDepth32F()))
        self.DeclareAbstractOutputPort(
            "depth_image",
            lambda: Value(ImageDepth32F(width, height)),
            self._calc_image,
            prerequisites_of_calc={self._image_port.ticket(), self.time_ticket()},
        )

    def _calc_image(self, context: Context, output: AbstractValue) -> None:
        image: Any = read_value(self, self._image_port, context, ImageDepth32F)
        measured: Any = output.get_mutable_value()
        if (measured.width(), measured.height()) != (image.width(), image.height()):
            measured.resize(image.width(), image.height())
        depth = image.data[:, :, 0]
        room: Any = self._room.Eval(context)
        if room.shape != depth.shape:
            room = None
        self._noise(depth, context.get_time(), out=measured.mutable_data[:, :, 0], room=room)
