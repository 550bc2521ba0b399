"""The camera's settings, read from its node's parameters."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node

from yolov5_lifecycle.images.image import MAX_SIDE_PX
from yolov5_lifecycle.ros.camera.transport import Transport
from yolov5_lifecycle.ros.qos_overrides import parameter_overrides
from yolov5_lifecycle.settings.parameter_file import FOREIGN_PREFIXES, QOS_PREFIX
from yolov5_lifecycle.settings.settings import Problem, SettingsError
from yolov5_lifecycle.settings.suggestion import did_you_mean
from yolov5_lifecycle.sources.calibration import Calibration, CalibrationError, read_calibration


def _number_as_text(value: object) -> object:
    return str(value) if type(value) is int else value


class CameraSettings(BaseModel):
    """A valid configuration of the camera, fixed at startup."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    source: Annotated[str, BeforeValidator(_number_as_text)] = Field(
        "synthetic",
        min_length=1,
        description="synthetic (moving shapes), a device's number or path, the path of a video, picture or "
        "folder, a URL such as rtsp://HOST/PATH, or a GStreamer pipeline that ends in appsink.",
    )
    rate: float = Field(
        0.0,
        ge=0,
        le=1000,
        description="Images per second. 0: what the video says or the device gives, 30 for anything else.",
    )
    width: int = Field(
        0, ge=0, le=MAX_SIDE_PX, description="Width of the images in pixels. 0: that of the source."
    )
    height: int = Field(
        0, ge=0, le=MAX_SIDE_PX, description="Height of the images in pixels. 0: that of the source."
    )
    loop: bool = Field(
        True,
        description="Begin again at the end of the files; connect again when a stream breaks off. "
        "false: play once to all subscribers and end.",
    )
    seed: int = Field(0, ge=0, description="Which synthetic scene to draw.")
    image_transport: Transport = Field(
        "raw", description="raw: on image_raw. compressed: as JPEG on image_raw/compressed. both: on both."
    )
    encoding: Literal["rgb8", "bgr8", "mono8", "rgba8", "bgra8"] = Field(
        "rgb8", description="Layout of the pixels in a message; of a JPEG, once unpacked."
    )
    frame_id: str = Field("camera", description="Coordinate frame in the header of the images.")
    camera_info_url: str = Field(
        "",
        description="Calibration for camera_info: file:///PATH or package://PACKAGE/PATH of a YAML file as "
        "camera_calibration writes it. Empty: not calibrated.",
    )
    reliability: Literal["reliable", "best_effort"] = Field(
        "reliable", description="Reliability offered to subscribers."
    )

    @model_validator(mode="after")
    def _has_no_or_both_sides(self) -> CameraSettings:
        if bool(self.width) != bool(self.height):
            raise PydanticCustomError("sides", "width and height go together: set both or none")
        return self

    @cached_property
    def calibration(self) -> Calibration | None:
        """Calibration at `camera_info_url`, None if that is empty; raises SettingsError."""
        if not self.camera_info_url:
            return None
        try:
            calibration = read_calibration(self.camera_info_url)
        except CalibrationError as error:
            raise SettingsError([Problem("camera_info_url", str(error))]) from None
        if self.size_hw not in (None, calibration.size_hw):
            asked, known = (
                f"{self.width} x {self.height}",
                f"{calibration.image_width} x {calibration.image_height}",
            )
            raise SettingsError(
                [Problem("width, height", f"{asked} asked for, the calibration is for {known}.")]
            )
        return calibration

    @property
    def size_hw(self) -> tuple[int, int] | None:
        """Size of the images in pixels, None for the size of the source."""
        return (self.height, self.width) if self.height else None


def declared_settings(node: Node) -> CameraSettings:
    """Read the settings from the parameter overrides of `node` and declare them as read-only parameters.

    Raises SettingsError with every problem: invalid values and unknown names.
    """
    values = {
        name: parameter.value
        for name, parameter in parameter_overrides(node).items()
        if not name.startswith(FOREIGN_PREFIXES)
    }
    try:
        settings = CameraSettings.model_validate(values)
    except ValidationError as error:
        problems = [_problem(details) for details in error.errors()]
    else:
        for name, field in CameraSettings.model_fields.items():
            described = ParameterDescriptor(description=field.description, read_only=True)
            node.declare_parameter(name, getattr(settings, name), described, ignore_override=True)
        return settings
    raise SettingsError(problems)


def check_qos_overrides(node: Node) -> None:
    """Raise SettingsError for `qos_overrides` that no publisher uses; call it after creating them all."""
    taken = [f"{QOS_PREFIX}{name}" for name in node.get_parameters_by_prefix(QOS_PREFIX.removesuffix("."))]
    unused = [name for name in parameter_overrides(node) if name.startswith(QOS_PREFIX) and name not in taken]
    if unused:
        reason = "no publisher here has this policy."
        raise SettingsError([Problem(name, f"{reason}{did_you_mean(name, taken)}") for name in unused])


def _problem(details: ErrorDetails) -> Problem:
    if details["type"] == "sides":
        return Problem("width, height", f"{details['msg']}.")
    name = str(details["loc"][0])
    if details["type"] == "extra_forbidden":
        return Problem(name, f"there is no such parameter.{did_you_mean(name, CameraSettings.model_fields)}")
    default = CameraSettings.model_fields[name].default
    return Problem(name, f"{details['input']!r}: {details['msg']}. The default is {default!r}.")
