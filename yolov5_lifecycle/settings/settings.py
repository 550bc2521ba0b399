"""The settings of the node: the only definition of their names, defaults, limits and rules."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError

from yolov5_lifecycle.models.architecture import SIZES, Size, image_size_problem
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.settings.field import Change, Setting, described
from yolov5_lifecycle.settings.suggestion import did_you_mean, nearest
from yolov5_lifecycle.settings.synonyms import NOT_SETTINGS, SYNONYMS


class Settings(BaseModel):
    """A valid configuration. Immutable: to change it, pass all values to `validated` again."""

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
        description="Longer side of the network's input in pixels: a multiple of the largest stride.",
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
        True,
        description="Do not subscribe to images while detections and annotated images have no subscribers.",
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
    bond_timeout: Annotated[float, Change.READ_ONLY] = Field(
        0.0,
        ge=0,
        le=3600,
        description="Seconds without a heartbeat after which Nav2's lifecycle manager gives the node up: the "
        "manager's own bond_timeout. Heartbeats are sent while active; needs the ROS package bond. 0: none.",
    )

    @field_validator("weights_dirs", "classes", mode="before")
    @classmethod
    def _are_strings(cls, value: object) -> object:
        """Report one problem per list, however many of its entries are wrong."""
        if isinstance(value, tuple) and not all(isinstance(entry, str) for entry in value):
            raise PydanticCustomError("strings", "must be strings")
        return value

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
        """Names of the settings whose `Change` is `change` and whose values differ."""
        return [
            setting.name
            for setting in SETTINGS
            if setting.change is change and getattr(self, setting.name) != getattr(other, setting.name)
        ]

    def digest(self) -> str:
        """Twelve hexadecimal digits that identify this configuration."""
        return hashlib.sha256(json.dumps(self.model_dump(), sort_keys=True).encode()).hexdigest()[:12]


SETTINGS: tuple[Setting, ...] = tuple(described(name, field) for name, field in Settings.model_fields.items())
SETTINGS_BY_NAME = {setting.name: setting for setting in SETTINGS}
_SHOWN_LETTERS = 100
"""Maximum characters of a value or an unknown name shown in a message."""


@dataclass(frozen=True)
class Problem:
    """One reason why values are not valid settings."""

    setting: str
    message: str

    def __str__(self) -> str:
        return f"{self.setting}: {self.message}"


class SettingsError(ValueError):
    """Invalid settings; `problems` lists every violated rule."""

    def __init__(self, problems: list[Problem]) -> None:
        super().__init__("\n".join(str(problem) for problem in problems))
        self.problems = problems


def validated(values: Mapping[str, object]) -> Settings:
    """Settings from values by name, with defaults for the rest; raises SettingsError with every problem."""
    prepared = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    try:
        return Settings.model_validate(prepared)
    except ValidationError as error:
        found = error.errors(include_url=False, include_input=False)
        problems = [problem for details in found for problem in _problems(details, prepared)]
    raise SettingsError(list(dict.fromkeys(problems)))  # one problem per list, however many entries are wrong


def _contradictions(settings: Settings) -> list[Problem]:
    """Violated rules that involve several settings."""
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
    hint = _hint(setting, value) if isinstance(value, str) else ""
    return f"{_shown(value)} is not {setting.allowed}.{hint} The default is {_shown(setting.default)}."


def _hint(setting: Setting, value: str) -> str:
    """What the user who wrote `value` probably meant, with a leading space, or an empty string."""
    if setting.type is not tuple:
        return did_you_mean(value, setting.choices)
    if len(value) > _SHOWN_LETTERS or not value.strip():
        return ""
    # A list of strings and integers is no ROS type: `ros2 param set` sends it as a string.
    entries = [
        entry.strip().strip("'\"") for entry in value.strip().removeprefix("[").removesuffix("]").split(",")
    ]
    return f" Did you mean [{', '.join(_as_yaml_string(entry) for entry in entries)}]?"


def _as_yaml_string(entry: str) -> str:
    return entry if entry.isidentifier() else json.dumps(entry, ensure_ascii=False)


def meant_setting(name: str) -> str | None:
    """The setting that was probably meant by `name`, or None."""
    if name in NOT_SETTINGS:
        return None
    return SYNONYMS.get(name) or nearest(name, SETTINGS_BY_NAME)


def unknown_setting(name: str, *, suggest: bool = True) -> Problem:
    """The problem for an unknown name, with the setting that was probably meant if `suggest`."""
    shown = in_one_line(name[:_SHOWN_LETTERS])
    if name in NOT_SETTINGS:
        return Problem(shown, f"there is no such parameter: {NOT_SETTINGS[name]}")
    meant = meant_setting(name) if suggest else None
    return Problem(shown, "there is no such parameter." + (f" Did you mean '{meant}'?" if meant else ""))


def _shown(value: object) -> str:
    """repr of `value`, truncated; work and length are bounded."""
    if isinstance(value, (list, tuple)):
        text = repr([_beginning(entry) for entry in value[:_SHOWN_LETTERS]])
    else:
        text = repr(_beginning(value))
    return text if len(text) <= _SHOWN_LETTERS else text[: _SHOWN_LETTERS - 3] + "..."


def _beginning(value: object) -> object:
    return value[: _SHOWN_LETTERS + 1] if isinstance(value, str) else value
