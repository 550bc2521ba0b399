"""The settings of the detector: the only definition of their names, defaults, limits and rules."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, field_validator, model_validator
from pydantic_core.core_schema import ValidationInfo

from yolov5_lifecycle.images.image import MAX_SIDE_PX
from yolov5_lifecycle.models.architecture import SIZES, Size, image_size_problem
from yolov5_lifecycle.process.missing_package import absence_of
from yolov5_lifecycle.settings.camera_overrides import MAX_CAMERAS, OverridableSchema, overrides_of
from yolov5_lifecycle.settings.schema import Change, Entries, Problem, Scope, contradiction
from yolov5_lifecycle.settings.synonyms import NOT_SETTINGS, SYNONYMS
from yolov5_lifecycle.settings.value_rules import COLLECT_REASONS, RULES, Rule, cameras

MAX_PARALLEL_FRAMES = 16
_RULES: Mapping[str, Rule] = {**RULES, "cameras": lambda value: cameras(value, Settings.model_fields)}


class Settings(BaseModel):
    """A valid configuration of the detector. To change it, pass all values to `validated` again."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    _overrides: dict[str, object] = PrivateAttr(default_factory=dict)

    model_size: Annotated[Size, Change.RELOAD] = Field(
        "n", description="Official model size; selects the file in weights_dir when weights is empty."
    )
    weights: Annotated[str, Change.RELOAD] = Field(
        "",
        max_length=4096,
        description="Weights file (.pt, .safetensors or .onnx): a path, ~ or package://PACKAGE/PATH. "
        "Empty: weights_dir/yolov5<model_size>.safetensors, else .pt. Set again, a file that has changed is "
        "loaded again.",
    )
    weights_dir: Annotated[str, Change.RELOAD] = Field(
        "~/.ros/yolov5", min_length=1, max_length=4096, description="Folder searched when weights is empty."
    )
    weights_sha256: Annotated[str, Change.RELOAD] = Field(
        "", description="Expected SHA-256 of the weights file, 64 hexadecimal digits. Empty: not checked."
    )
    weights_dirs: Annotated[tuple[str, ...], Change.READ_ONLY] = Field(
        (),
        max_length=100,
        description="Folders from which weights may be loaded: absolute paths, ~ or package://PACKAGE/PATH. "
        "Empty: any folder.",
    )
    device: Annotated[str, Change.RELOAD] = Field(
        "auto",
        description="Device that runs the network: auto, cpu, cuda, cuda:N, N (the same as cuda:N) or mps. "
        "auto: the first CUDA device, otherwise the CPU.",
    )
    runtime: Annotated[Literal["auto", "torch", "onnxruntime", "openvino"], Change.RELOAD] = Field(
        "auto",
        description="Library that runs the network. auto: torch on a GPU; on a CPU the fastest installed "
        "one, measured once and cached. onnxruntime and openvino run on the CPU only.",
    )
    precision: Annotated[Literal["auto", "fp32", "fp16", "bf16", "int8"], Change.RELOAD] = Field(
        "auto",
        description="Precision of the network. auto: fp16 on CUDA, fp32 on a CPU. fp16 needs a GPU, bf16 and "
        "int8 a CPU; int8 needs the file that calibrate writes.",
    )
    image_size: Annotated[int, Change.RELOAD] = Field(
        640,
        ge=64,
        le=4096,
        multiple_of=32,
        description="Longer side of the network input in pixels; a multiple of the model's largest stride.",
    )
    confidence_threshold: Annotated[float, Change.LIVE, Scope.CAMERA] = Field(
        0.25, ge=0, le=1, description="Detections with a lower score are dropped."
    )
    iou_threshold: Annotated[float, Change.LIVE, Scope.CAMERA] = Field(
        0.45,
        ge=0,
        le=1,
        description="IoU threshold of NMS: of two boxes that overlap more, the one with the lower score is "
        "dropped.",
    )
    max_detections: Annotated[int, Change.LIVE, Scope.CAMERA] = Field(
        1000, ge=1, le=30_000, description="Maximum number of detections per frame; the best ones are kept."
    )
    classes: Annotated[tuple[str, ...], Change.LIVE, Scope.CAMERA] = Field(
        (), max_length=10_000, description="Names or indices of the classes to detect. Empty: all."
    )
    class_thresholds: Annotated[tuple[str, ...], Change.LIVE, Scope.CAMERA] = Field(
        (), max_length=10_000, description='Thresholds for single classes: ["person: 0.5", "3: 0.2"].'
    )
    regions: Annotated[tuple[str, ...], Change.LIVE, Scope.CAMERA, Entries.WITH_COMMAS] = Field(
        (),
        max_length=32,
        description="Polygons in which detections count, with points x,y in fractions of the image: "
        '["0,0.5 1,0.5 1,1 0,1"] is its lower half. Empty: the whole image.',
    )
    ignore_regions: Annotated[tuple[str, ...], Change.LIVE, Scope.CAMERA, Entries.WITH_COMMAS] = Field(
        (), max_length=32, description="Polygons in which detections do not count, written like regions."
    )
    region_anchor: Annotated[Literal["center", "foot"], Change.LIVE, Scope.CAMERA] = Field(
        "center", description="Point of a box that must be in a region. foot: the middle of its lower side."
    )
    min_box_size: Annotated[float, Change.LIVE, Scope.CAMERA] = Field(
        0.0,
        ge=0,
        le=MAX_SIDE_PX,
        description="Minimum length of the longer side of a box: up to 1 a fraction of the longer side of "
        "the image, above 1 pixels. 0: no minimum.",
    )
    max_box_size: Annotated[float, Change.LIVE, Scope.CAMERA] = Field(
        0.0, ge=0, le=MAX_SIDE_PX, description="Maximum length, like min_box_size. 0: no maximum."
    )
    agnostic_nms: Annotated[bool, Change.LIVE, Scope.CAMERA] = Field(
        False, description="Class-agnostic NMS: boxes of different classes suppress each other."
    )
    max_rate: Annotated[float, Change.LIVE, Scope.CAMERA] = Field(
        0.0, ge=0, le=1000, description="Maximum rate of inference in frames per second. 0: no limit."
    )
    tracker: Annotated[Literal["none", "bytetrack"], Change.LIVE, Scope.CAMERA] = Field(
        "none",
        description="bytetrack: give the same object the same Detection2D.id in every image; requires scipy. "
        "none: ids are empty.",
    )
    track_high_threshold: Annotated[float, Change.LIVE, Scope.CAMERA] = Field(
        0.25, ge=0, le=1, description="Minimum score of a detection that may begin a track."
    )
    track_low_threshold: Annotated[float, Change.LIVE, Scope.CAMERA] = Field(
        0.1,
        ge=0,
        le=1,
        description="Minimum score of a detection that may continue a track, published or not; at most "
        "track_high_threshold.",
    )
    track_match_threshold: Annotated[float, Change.LIVE, Scope.CAMERA] = Field(
        0.2,
        ge=0.01,
        le=1,
        description="Minimum IoU of a detection and the predicted box of the track that it continues.",
    )
    track_timeout: Annotated[float, Change.LIVE, Scope.CAMERA] = Field(
        1.5, ge=0.01, le=60, description="Seconds for which a track is kept without a detection."
    )
    track_across_classes: Annotated[bool, Change.LIVE, Scope.CAMERA] = Field(
        False, description="Whether a track may continue with a detection of another class."
    )
    track_camera_motion: Annotated[Literal["auto", "off"], Change.LIVE, Scope.CAMERA] = Field(
        "auto",
        description="auto: the tracker finds in the images how the camera moved, and moves its tracks along. "
        "off: the camera counts as still.",
    )
    lazy: Annotated[bool, Change.LIVE, Scope.CAMERA] = Field(
        True,
        description="Subscribe to images only while detections, masks or annotated images have subscribers.",
    )
    max_consecutive_failures: Annotated[int, Change.LIVE] = Field(
        10,
        ge=1,
        le=10_000,
        description="Number of consecutive failed frames after which the node deactivates itself.",
    )
    cameras: Annotated[tuple[str, ...], Change.CONFIGURE] = Field(
        (),
        max_length=MAX_CAMERAS,
        description="Names of several cameras that share the model: detections in ~/NAME/image_raw are "
        "published on ~/NAME/detections, and NAME.max_rate overrides max_rate for one camera. Empty: one "
        "camera, ~/image_raw.",
    )
    parallel_frames: Annotated[int, Change.RELOAD] = Field(
        0,
        ge=0,
        le=MAX_PARALLEL_FRAMES,
        description="Maximum number of frames, of different cameras, that are in progress at the same time "
        "and share the processors. 0: measured when the model is loaded. 1: one frame at a time.",
    )
    image_transport: Annotated[Literal["raw", "compressed"], Change.RESUBSCRIBE, Scope.CAMERA] = Field(
        "raw", description="raw: ~/image_raw (Image). compressed: ~/image_raw/compressed (CompressedImage)."
    )
    image_reliability: Annotated[
        Literal["auto", "best_effort", "reliable"], Change.RESUBSCRIBE, Scope.CAMERA
    ] = Field(
        "auto", description="QoS reliability of the image subscription. auto: what the publishers offer."
    )
    depth: Annotated[bool, Change.RESUBSCRIBE, Scope.CAMERA] = Field(
        False,
        description="Publish ~/detections_3d, where detections are in space, and ~/points, from "
        "~/depth/image_raw and ~/depth/camera_info.",
    )
    depth_slop_s: Annotated[float, Change.RESUBSCRIBE, Scope.CAMERA] = Field(
        0.05,
        ge=0,
        le=10,
        description="Largest difference in seconds between the stamps of an image and of its depth image.",
    )
    target_frame: Annotated[str, Change.LIVE, Scope.CAMERA] = Field(
        "",
        max_length=256,
        description="Frame of ~/detections_3d and ~/points, such as base_link or map, by tf2. Empty: that of "
        "the camera.",
    )
    transform_timeout_s: Annotated[float, Change.LIVE, Scope.CAMERA] = Field(
        0.5,
        ge=0,
        le=10,
        description="How long results in space wait for the transform to target_frame at their stamp.",
    )
    points_classes: Annotated[tuple[str, ...], Change.LIVE, Scope.CAMERA] = Field(
        (),
        max_length=10_000,
        description="Names or indices of the classes whose points are on ~/points, with depth. Empty: all.",
    )
    points_spacing_m: Annotated[float, Change.LIVE, Scope.CAMERA] = Field(
        0.02,
        ge=0,
        le=10,
        description="Distance in metres between neighbouring points on ~/points. 0: a point for each pixel.",
    )
    collect: Annotated[bool, Change.LIVE, Scope.CAMERA] = Field(
        False, description="Keep the images that are worth a label in collect_dir; see docs/data-loop.md."
    )
    collect_reasons: Annotated[tuple[str, ...], Change.LIVE, Scope.CAMERA] = Field(
        COLLECT_REASONS,
        max_length=10_000,
        description="Why an image is kept: uncertain (a score is close to its threshold), unusual (unlike "
        "what the camera usually sees), novel (unlike all kept images), classes, as in 'class: person'. "
        "Empty: on request only.",
    )
    collect_per_minute: Annotated[float, Change.LIVE, Scope.CAMERA] = Field(
        20.0,
        ge=0,
        le=6000,
        description="Maximum number of kept images of a camera per minute, in the mean of five. 0: no limit.",
    )
    collect_blank_regions: Annotated[tuple[str, ...], Change.LIVE, Scope.CAMERA, Entries.WITH_COMMAS] = Field(
        (),
        max_length=32,
        description="Polygons that are black in kept images, such as faces or screens, written like regions.",
    )
    collect_dir: Annotated[str, Change.READ_ONLY] = Field(
        "",
        max_length=4096,
        description="Folder of the kept images, of this detector alone: an absolute path or ~. It is created "
        "if its parent folder exists. Empty: nothing can be collected.",
    )
    collect_max_mb: Annotated[int, Change.READ_ONLY] = Field(
        2000,
        ge=1,
        le=10_000_000,
        description="Maximum size of collect_dir in MB; the least valuable images are removed first.",
    )
    collect_min_free_mb: Annotated[int, Change.READ_ONLY] = Field(
        1000,
        ge=0,
        le=10_000_000,
        description="Nothing is kept while less than this is free on the disk of collect_dir, in MB.",
    )
    autostart: Annotated[bool, Change.READ_ONLY] = Field(
        False, description="Configure and activate automatically, once, when the process starts."
    )
    bond_timeout: Annotated[float, Change.READ_ONLY] = Field(
        0.0,
        ge=0,
        le=3600,
        description="Seconds without a heartbeat after which Nav2's lifecycle manager considers the node "
        "dead: the manager's own bond_timeout. Heartbeats are sent while active; requires the ROS package "
        "bond. 0: no bond.",
    )

    @field_validator("*", mode="before")
    @classmethod
    def _are_strings(cls, value: object) -> object:
        """Report one problem per list, however many of its entries are wrong."""
        if isinstance(value, tuple) and not all(isinstance(entry, str) for entry in value):
            raise ValueError("must be strings")
        return value

    @field_validator(*_RULES)
    @classmethod
    def _follows_its_rule(cls, value: object, info: ValidationInfo) -> object:
        name = str(info.field_name)
        return value if value == cls.model_fields[name].default else _RULES[name](value)

    @model_validator(mode="after")
    def _agrees(self) -> Settings:
        if problems := [*_contradictions(self)]:
            raise contradiction(problems)
        return self

    def model_post_init(self, context: Mapping[str, object] | None, /) -> None:
        """Take the valid overrides that `validated` passes."""
        self._overrides = dict(context or {})

    @property
    def overrides(self) -> Mapping[str, object]:
        """Values of the overrides by dotted name, such as `front.max_rate`."""
        return self._overrides

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Names of the cameras; one empty name without `cameras`."""
        return self.cameras or ("",)

    def for_camera(self, name: str) -> Settings:
        """Settings of one of `camera_names`, as of a node with this camera alone; KeyError for others."""
        if name not in self.camera_names:
            raise KeyError(f"expected a camera of {self.camera_names}, found {name!r}")
        if not name:
            return self
        own = overrides_of(name, self._overrides)
        given = self.model_fields_set | own.keys()
        return Settings.model_construct(given, **{**dict(self), "cameras": (), **own})

    def differing(self, other: Settings, change: Change) -> list[str]:
        """Names of the settings and overrides whose `Change` is `change` and whose values differ."""
        ours, others = {**dict(self), **self.overrides}, {**dict(other), **other.overrides}
        names = [name for name in {**ours, **others} if ours.get(name) != others.get(name)]
        return [name for name in names if (setting := SCHEMA.find(name)) and setting.change is change]

    def digest(self) -> str:
        """Twelve hexadecimal digits that identify this configuration."""
        return hashlib.sha256(
            json.dumps({**self.model_dump(), **self.overrides}, sort_keys=True).encode()
        ).hexdigest()[:12]


SCHEMA = OverridableSchema(Settings, synonyms=SYNONYMS, not_settings=NOT_SETTINGS)
SETTINGS = SCHEMA.settings
SETTINGS_BY_NAME = SCHEMA.by_name
validated = SCHEMA.validated


def _contradictions(settings: Settings) -> Iterator[Problem]:
    """Violated rules that involve several settings, or the machine."""
    if rule := _precision_rule(settings.precision, settings.device, settings.runtime):
        yield Problem("precision", rule)
    stride = max(SIZES[settings.model_size].strides)
    if settings.image_size % stride and not settings.weights:
        whose = f"model_size '{settings.model_size}'"
        yield Problem("image_size", image_size_problem(settings.image_size, stride, whose=whose))
    low, high = settings.track_low_threshold, settings.track_high_threshold
    if low > high:
        yield _not_above("track_low_threshold", low, "track_high_threshold", high)
    low, high = settings.min_box_size, settings.max_box_size
    if 0 < high < low and (low > 1) == (high > 1):  # a fraction and pixels cannot be compared
        yield _not_above("min_box_size", low, "max_box_size", high)
    if settings.collect and not settings.collect_dir:
        yield Problem("collect", "true needs a folder. Restart the node with collect_dir set to one.")
    if settings.tracker != "none" and (absence := absence_of("scipy.optimize")):
        remedy = f"{absence.rstrip('.')}, or use the tracker 'none'."
        yield Problem("tracker", f"'{settings.tracker}' needs scipy. {remedy}")


def _not_above(name: str, value: float, bound: str, most: float) -> Problem:
    return Problem(name, f"{value:g} is above {bound}, {most:g}. Lower it, or raise the other.")


def _precision_rule(precision: str, device: str, runtime: str) -> str:
    """The rule that the three violate together, or ""."""
    if precision == "fp16" and device == "cpu":
        return "'fp16' needs a GPU, but device is 'cpu'. Use precision 'auto' or 'fp32'."
    if precision not in ("int8", "bf16"):
        return ""
    if device not in ("auto", "cpu"):
        return (
            f"'{precision}' runs on the CPU only, but device is '{device}'. Use device 'cpu' or precision "
            "'auto'."
        )
    if runtime not in ("auto", "openvino"):
        return (
            f"'{precision}' needs OpenVINO, but runtime is '{runtime}'. Use runtime 'auto', or precision "
            "'fp32'."
        )
    return ""
