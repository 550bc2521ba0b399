"""The camera's settings, read from its node's parameters."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator
from rclpy.node import Node

from yolov5_lifecycle.images.image import MAX_FRAME_ID, MAX_SIDE_PX
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros.parameters.declaration import declare
from yolov5_lifecycle.ros.rclpy_internals import parameter_overrides
from yolov5_lifecycle.settings.schema import Change, Problem, Schema, SettingsError, contradiction
from yolov5_lifecycle.settings.suggestion import did_you_mean
from yolov5_lifecycle.settings.synonyms import QOS_PREFIX
from yolov5_lifecycle.sources.camera_info import CameraInfoValues, read_camera_info
from yolov5_lifecycle.sources.source import SYNTHETIC


class CameraSettings(BaseModel):
    """A valid configuration of the camera, fixed at startup."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    source: Annotated[str, Change.READ_ONLY] = Field(
        "synthetic",
        min_length=1,
        description="synthetic (moving shapes), the number or path of a device, the path of a video, image "
        "or folder, a URL such as rtsp://HOST/PATH, or a GStreamer pipeline that ends in appsink.",
    )
    rate: Annotated[float, Change.READ_ONLY] = Field(
        0.0,
        ge=0,
        le=1000,
        description="Images per second. 0: the rate of the video or device, 30 for other sources.",
    )
    width: Annotated[int, Change.READ_ONLY] = Field(
        0, ge=0, le=MAX_SIDE_PX, description="Width of the images in pixels. 0: that of the source."
    )
    height: Annotated[int, Change.READ_ONLY] = Field(
        0, ge=0, le=MAX_SIDE_PX, description="Height of the images in pixels. 0: that of the source."
    )
    loop: Annotated[bool, Change.READ_ONLY] = Field(
        True,
        description="Restart at the end of the files; reconnect when a stream breaks off. "
        "false: play once to all subscribers and exit.",
    )
    seed: Annotated[int, Change.READ_ONLY] = Field(0, ge=0, description="Seed of the synthetic scene.")
    depth: Annotated[bool, Change.READ_ONLY] = Field(
        False,
        description="Also publish depth images of the synthetic scene, on depth/image_raw and "
        "depth/camera_info, and the places of its shapes in space, on ~/ground_truth_3d.",
    )
    image_transport: Annotated[Literal["raw", "compressed", "both"], Change.READ_ONLY] = Field(
        "raw", description="raw: on image_raw. compressed: as JPEG on image_raw/compressed. both: on both."
    )
    encoding: Annotated[Literal["rgb8", "bgr8", "mono8", "rgba8", "bgra8"], Change.READ_ONLY] = Field(
        "rgb8", description="Encoding of the images; of a JPEG, after decompression."
    )
    frame_id: Annotated[str, Change.READ_ONLY] = Field(
        "camera", max_length=MAX_FRAME_ID, description="Coordinate frame in the header of the images."
    )
    camera_info_url: Annotated[str, Change.READ_ONLY] = Field(
        "",
        description="Calibration for camera_info: file:///PATH or package://PACKAGE/PATH of a YAML file as "
        "camera_calibration writes it. Empty: not calibrated.",
    )
    reliability: Annotated[Literal["reliable", "best_effort"], Change.READ_ONLY] = Field(
        "reliable", description="QoS reliability offered to subscribers."
    )

    @model_validator(mode="after")
    def _has_no_or_both_sides(self) -> CameraSettings:
        if bool(self.width) != bool(self.height):
            raise contradiction([Problem("width, height", "width and height go together: set both or none.")])
        return self

    @model_validator(mode="after")
    def _has_depth_of_the_scene_only(self) -> CameraSettings:
        problems = []
        if self.depth and self.source != SYNTHETIC:
            source = in_one_line(self.source)
            problem = f"only the source '{SYNTHETIC}' has depth, not '{source}': leave out one of them."
            problems.append(Problem("depth, source", problem))
        if self.depth and self.camera_info_url:
            problem = "with depth, camera_info describes the camera of the scene: leave out one of them."
            problems.append(Problem("depth, camera_info_url", problem))
        if problems:
            raise contradiction(problems)
        return self

    @cached_property
    def camera_info(self) -> CameraInfoValues | None:
        """The values at `camera_info_url`, None if that is empty; raises SettingsError."""
        if not self.camera_info_url:
            return None
        try:
            camera_info = read_camera_info(self.camera_info_url)
        except ValueError as error:
            raise SettingsError([Problem("camera_info_url", str(error))]) from None
        if self.size_hw not in (None, camera_info.size_hw):
            asked = f"{self.width} x {self.height}"
            known = f"{camera_info.image_width} x {camera_info.image_height}"
            raise SettingsError(
                [Problem("width, height", f"{asked} requested, but the calibration is for {known}.")]
            )
        return camera_info

    @property
    def size_hw(self) -> tuple[int, int] | None:
        """Size of the images in pixels, None for the size of the source."""
        return (self.height, self.width) if self.height else None


SCHEMA = Schema(CameraSettings)


def declared_settings(node: Node) -> CameraSettings:
    """Declare the settings as read-only parameters of `node`, with the values of its overrides.

    Raises SettingsError with every problem: invalid values and unknown names.
    """
    return SCHEMA.validated(declare(node, SCHEMA))


def check_qos_overrides(node: Node) -> None:
    """Raise SettingsError for `qos_overrides` that no publisher uses; call it after creating them all."""
    taken = [f"{QOS_PREFIX}{name}" for name in node.get_parameters_by_prefix(QOS_PREFIX.removesuffix("."))]
    unused = [name for name in parameter_overrides(node) if name.startswith(QOS_PREFIX) and name not in taken]
    if unused:
        reason = "no publisher of this node has such a policy."
        raise SettingsError([Problem(name, f"{reason}{did_you_mean(name, taken)}") for name in unused])
