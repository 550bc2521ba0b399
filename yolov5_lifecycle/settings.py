"""What a user may set, and the rules: the only place where a setting, its default and its bounds stand."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError

from yolov5_lifecycle.architecture import SIZES, Size, image_size_problem
from yolov5_lifecycle.setting import Change, Setting, described
from yolov5_lifecycle.suggestion import did_you_mean, nearest


class Settings(BaseModel):
    """A valid configuration. Immutable: a change is a new value, made by `validated` from all values."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    model_size: Annotated[Size, Change.RELOAD] = Field(
        "n", description="Official size of the model; names the file in weights_dir when weights is empty."
    )
    weights: Annotated[str, Change.RELOAD] = Field(
        "",
        max_length=4096,
        description="Weights file (.pt or .safetensors): a path, ~ or package://PACKAGE/PATH. "
        "Empty: weights_dir/yolov5<model_size>.safetensors, else .pt.",
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
        description="The only folders that weights may come from: absolute paths, ~ or "
        "package://PACKAGE/PATH. Empty: any.",
    )
    device: Annotated[str, Change.RELOAD] = Field(
        "auto",
        description="Where the network runs: auto, cpu, cuda, cuda:N, N (the same as cuda:N) or mps. "
        "auto: the first CUDA device, else the CPU.",
    )
    runtime: Annotated[Literal["auto", "torch", "onnxruntime", "openvino"], Change.RELOAD] = Field(
        "auto",
        description="What executes the network. auto: torch on a GPU; on a CPU the fastest that is "
        "installed, measured once and remembered. onnxruntime and openvino run on the CPU only.",
    )
    precision: Annotated[Literal["auto", "fp32", "fp16"], Change.RELOAD] = Field(
        "auto", description="Number format of the network. auto: fp16 on CUDA, fp32 elsewhere."
    )
    image_size: Annotated[int, Change.RELOAD] = Field(
        640,
        ge=64,
        le=4096,
        multiple_of=32,
        description="Longer side of the network's picture in pixels: a multiple of the largest stride.",
    )
    confidence_threshold: Annotated[float, Change.LIVE] = Field(
        0.25, ge=0, le=1, description="Detections with a lower score are dropped."
    )
    iou_threshold: Annotated[float, Change.LIVE] = Field(
        0.45, ge=0, le=1, description="Of two boxes that overlap more than this, the lower score is dropped."
    )
    max_detections: Annotated[int, Change.LIVE] = Field(
        1000, ge=1, le=30_000, description="At most this many detections per frame, best first."
    )
    classes: Annotated[tuple[str, ...], Change.LIVE] = Field(
        (), max_length=10_000, description="Names or indices of the classes to report. Empty: all."
    )
    agnostic_nms: Annotated[bool, Change.LIVE] = Field(
        False, description="Let boxes of different classes suppress each other."
    )
    max_rate: Annotated[float, Change.LIVE] = Field(
        0.0, ge=0, le=1000, description="At most this many frames per second are detected. 0: no limit."
    )
    lazy: Annotated[bool, Change.LIVE] = Field(
        True, description="Do not subscribe to images while nobody listens to detections or annotated images."
    )
    max_consecutive_failures: Annotated[int, Change.LIVE] = Field(
        10, ge=1, le=10_000, description="After this many failed frames in a row the node deactivates itself."
    )
    image_transport: Annotated[Literal["raw", "compressed"], Change.RESUBSCRIBE] = Field(
        "raw", description="raw: ~/image_raw (Image). compressed: ~/image_raw/compressed (CompressedImage)."
    )
    image_reliability: Annotated[Literal["auto", "best_effort", "reliable"], Change.RESUBSCRIBE] = Field(
        "auto", description="Reliability asked of the camera. auto: what its publisher offers."
    )
    autostart: Annotated[bool, Change.READ_ONLY] = Field(
        False, description="Configure and activate without being asked, once, when the process starts."
    )

    @field_validator("weights_sha256")
    @classmethod
    def _is_sha256(cls, value: str) -> str:
        if value and (len(value) != 64 or set(value.lower()) - set("0123456789abcdef")):
            raise PydanticCustomError("sha256", "must be 64 hexadecimal digits or empty")
        return value.lower()

    @field_validator("weights_dirs")
    @classmethod
    def _are_absolute(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if not all(folder.startswith(("/", "~", "package://")) for folder in value):
            raise PydanticCustomError("folders", "must be absolute paths, or begin with ~ or package://.")
        return value

    @field_validator("device")
    @classmethod
    def _is_device(cls, value: str) -> str:
        kind, _, index = value.partition(":")
        is_index = index.isascii() and index.isdigit() and len(index) <= 3
        if value in ("auto", "cpu", "cuda", "mps") or (kind == "cuda" and is_index):
            return value
        if value.isascii() and value.isdigit() and len(value) <= 3:
            return f"cuda:{value}"
        hint = (
            " Did you mean 'cuda'?"
            if value.lower() == "gpu"
            else did_you_mean(value, ("auto", "cpu", "cuda", "mps"))
        )
        raise PydanticCustomError(
            "device", "must be auto, cpu, cuda, cuda:N, N or mps.{hint}", {"hint": hint}
        )

    @model_validator(mode="after")
    def _agrees(self) -> Settings:
        if problems := _contradictions(self):
            raise PydanticCustomError(
                "contradiction", "settings contradict each other", {"problems": problems}
            )
        return self

    def differing(self, other: Settings, change: Change) -> list[str]:
        """Names of the settings of kind `change` whose values differ."""
        return [
            setting.name
            for setting in SETTINGS
            if setting.change is change and getattr(self, setting.name) != getattr(other, setting.name)
        ]

    def digest(self) -> str:
        """Twelve hexadecimal digits that name this configuration."""
        return hashlib.sha256(json.dumps(self.model_dump(), sort_keys=True).encode()).hexdigest()[:12]


SETTINGS: tuple[Setting, ...] = tuple(described(name, field) for name, field in Settings.model_fields.items())
SETTINGS_BY_NAME = {setting.name: setting for setting in SETTINGS}


@dataclass(frozen=True)
class Problem:
    """One reason why values are no valid settings."""

    setting: str
    message: str

    def __str__(self) -> str:
        return f"{self.setting}: {self.message}"


class SettingsError(ValueError):
    """Values that break rules; `problems` has all of them."""

    def __init__(self, problems: list[Problem]) -> None:
        super().__init__("\n".join(str(problem) for problem in problems))
        self.problems = problems


def validated(values: Mapping[str, object]) -> Settings:
    """Settings from plain values by name, defaults for the rest; raises SettingsError with every problem."""
    prepared = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    try:
        return Settings.model_validate(prepared)
    except ValidationError as error:
        problems = [problem for details in error.errors() for problem in _problems(details, prepared)]
    raise SettingsError(list(dict.fromkeys(problems)))  # a list is told once, however many entries are wrong


def _contradictions(settings: Settings) -> list[Problem]:
    """Rules between several settings."""
    problems = []
    if settings.precision == "fp16" and settings.device == "cpu":
        problems.append(
            Problem("precision", "'fp16' needs a GPU, but device is 'cpu'. Use precision 'auto' or 'fp32'.")
        )
    stride, whose = max(SIZES[settings.model_size].strides), f"model_size '{settings.model_size}'"
    reason = image_size_problem(settings.image_size, stride, whose=whose)
    if reason and not settings.weights:
        problems.append(Problem("image_size", reason))
    return problems


def _problems(details: ErrorDetails, values: Mapping[str, object]) -> list[Problem]:
    if details["type"] == "contradiction":
        return list(details["ctx"]["problems"])
    name = str(details["loc"][0])
    if details["type"] == "extra_forbidden":
        return [unknown_setting(name)]
    setting = SETTINGS_BY_NAME[name]
    reason = _reason(setting, values[name], details)
    if setting.change is Change.READ_ONLY:
        reason += " It is read when the process starts: start it again with another value."
    return [Problem(name, reason)]


def _reason(setting: Setting, value: object, details: ErrorDetails) -> str:
    if details["type"] in ("sha256", "device", "folders"):
        return f"{_shown(value)} {details['msg']}"
    hint = did_you_mean(value, setting.choices) if isinstance(value, str) and setting.choices else ""
    return f"{_shown(value)} is not {setting.allowed}.{hint} The default is {_shown(setting.default)}."


# What the same thing is called in YOLOv5's own scripts and in other nodes.
_ELSEWHERE = {
    "half": "precision",
    "conf": "confidence_threshold",
    "conf_thres": "confidence_threshold",
    "threshold": "confidence_threshold",
    "iou": "iou_threshold",
    "iou_thres": "iou_threshold",
    "nms_threshold": "iou_threshold",
    "imgsz": "image_size",
    "imgsz_height": "image_size",
    "imgsz_width": "image_size",
    "max_det": "max_detections",
    "model": "weights",
    "model_file": "weights",
    "model_path": "weights",
    "weights_url": "weights",
}
_TOPIC = "topics are remapped: -r '~/image_raw:=/camera/image_raw'."
_SWITCH = "not needed: ~/image is published while somebody listens."
# What is no setting here at all.
_NO_SETTING = {
    "image_topic": _TOPIC,
    "input_topic": _TOPIC,
    "camera_topic": _TOPIC,
    "input_image_topic": _TOPIC,
    "pub_image": _SWITCH,
    "pub_result_img": _SWITCH,
    "publish_image": _SWITCH,
    "show_result": _SWITCH,
}


def meant_setting(name: str) -> str | None:
    """The setting that somebody who wrote `name` probably meant."""
    if name in _NO_SETTING:
        return None
    return _ELSEWHERE.get(name) or nearest(name, SETTINGS_BY_NAME)


def unknown_setting(name: str) -> Problem:
    """The problem of a name that is no setting."""
    if name in _NO_SETTING:
        return Problem(name, f"there is no such parameter: {_NO_SETTING[name]}")
    meant = meant_setting(name)
    return Problem(name, "there is no such parameter." + (f" Did you mean '{meant}'?" if meant else ""))


def _shown(value: object) -> str:
    text = repr(list(value) if isinstance(value, tuple) else value)
    return text if len(text) <= 100 else text[:97] + "..."
