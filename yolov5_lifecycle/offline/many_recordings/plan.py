"""The plan for every one of many recordings, which each worker gets."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from yolov5_lifecycle.checkpoints.locate import weights_digest
from yolov5_lifecycle.detection.prepared_model import weights_path
from yolov5_lifecycle.quantization.calibration_file import calibration_digest
from yolov5_lifecycle.settings.settings import Settings, validated

_PLACE_OF_WEIGHTS = {"model_size", "weights", "weights_dir", "weights_dirs", "weights_sha256"}
"""Settings that say where the model is, not which one it is."""
_ADDED_LATER = {"suffix", "crops"}
"""Options that count once they are used, so that the digests of earlier results stay the same."""


@dataclass(frozen=True)
class Options:
    """What the results have: of the images on `topic`, None for the only one, in topics of `node`."""

    topic: str | None
    node: str
    images: bool
    masks: bool
    suffix: str = ""
    """The format of the results in FORMATS; "": recordings become recordings, and videos JSON lines."""
    crops: bool = False


@dataclass(frozen=True)
class Plan:
    """The model, the settings and the options for all recordings, and the folder of their results."""

    output: Path
    options: Options
    settings: Settings
    """They select the weights by absolute path and digest."""
    settings_sha256: str
    """Digest of everything but model and recording that the results depend on."""
    is_open: bool
    """Whether the runtime depends on what is measured."""

    def chosen(self, runtime: str, precision: str) -> Plan:
        """The plan with what the first worker has chosen."""
        return replace(
            self, settings=_changed(self.settings, runtime=runtime, precision=precision), is_open=False
        )


def plan_of(settings: Settings, output: Path, options: Options) -> Plan:
    """The plan for the model that `settings` select, as its file is now; raises WeightsError and OSError."""
    weights = Path(os.path.abspath(weights_path(settings)))  # noqa: PTH100
    digest = weights_digest(weights, sha256=settings.weights_sha256)
    calibration = calibration_digest(weights) if settings.precision == "int8" else None
    return Plan(
        output=output,
        options=options,
        settings=_changed(settings, weights=str(weights), weights_sha256=digest),
        settings_sha256=_settings_sha256(settings.model_dump(mode="json"), options, calibration),
        is_open=settings.runtime == "auto",
    )


def _changed(settings: Settings, **values: str) -> Settings:
    return validated({**settings.model_dump(mode="json"), **values})


def _settings_sha256(values: Mapping[str, object], options: Options, calibration: str | None) -> str:
    """`calibration`: the digest of the one that int8 uses."""
    settings = {name: value for name, value in values.items() if name not in _PLACE_OF_WEIGHTS}
    used = {name: value for name, value in asdict(options).items() if value or name not in _ADDED_LATER}
    text = json.dumps([settings, used, *([calibration] if calibration else [])], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
