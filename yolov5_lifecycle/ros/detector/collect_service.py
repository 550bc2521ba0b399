"""The service `~/collect`, and the folder of collected images."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rclpy.node import Node
from std_srvs.srv import Trigger

from yolov5_lifecycle.collecting.collected_folder import CollectedFolder, Quota, RecordingSession
from yolov5_lifecycle.collecting.collector import Collector, CollectorStatus
from yolov5_lifecycle.ros.detector.detector_camera import DetectorCamera
from yolov5_lifecycle.ros.parameters.settings_parameters import SettingsParameters

_CLOSE_TIMEOUT_S = 3.0


class CollectService:
    """Owns `collector`, which keeps images of `cameras`, and the service with which somebody asks for one.

    `collector` is None without the parameter `collect_dir`, which like the quota is that of the start.
    """

    def __init__(
        self, node: Node, parameters: SettingsParameters, cameras: Mapping[str, DetectorCamera]
    ) -> None:
        self._node = node
        self._cameras = cameras
        self.collector = _collector(parameters)
        node.create_service(Trigger, "~/collect", self._collect)

    @property
    def status(self) -> CollectorStatus | None:
        """What became of images that were worth a label; None without a folder for them."""
        return self.collector.status if self.collector is not None else None

    def close(self) -> None:
        """Keep what waits; a thread that hangs in the disk is abandoned and logged."""
        if self.collector is not None and not self.collector.close(_CLOSE_TIMEOUT_S):
            self._node.get_logger().warning(
                f"an image has not been written within {_CLOSE_TIMEOUT_S:g} s: its thread is abandoned"
            )

    def _collect(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Keep the next image of each camera that collects."""
        if self.collector is None:
            response.message = "there is no folder: restart the node with collect_dir set to one"
            return response
        asked = [camera for camera in self._cameras.values() if camera.collect_next()]
        response.success = bool(asked)
        names = ", ".join(camera.name for camera in asked if camera.name)
        response.message = (
            f"the next image{f' of {names}' if names else ''} is kept"
            if asked
            else "no camera collects: activate the node, and set collect to true"
        )
        if problem := self.collector.status.problem:
            response.success, response.message = False, f"no image was kept at the last attempt: {problem}"
        return response


def _collector(parameters: SettingsParameters) -> Collector | None:
    folder = str(parameters.value("collect_dir"))
    if not folder:
        return None
    quota = Quota(
        max_bytes=parameters.value("collect_max_mb") * 1_000_000,
        min_free_bytes=parameters.value("collect_min_free_mb") * 1_000_000,
    )
    session = RecordingSession()
    return Collector(lambda: CollectedFolder(Path(folder).expanduser(), quota, session=session))
