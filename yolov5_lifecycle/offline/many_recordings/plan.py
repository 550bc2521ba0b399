"""The plan for every one of many recordings, in a form that can be sent to workers."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from yolov5_lifecycle.checkpoints.locate import weights_digest
from yolov5_lifecycle.detection.prepared_model import weights_path
from yolov5_lifecycle.quantization.calibration_file import calibration_digest
from yolov5_lifecycle.settings.settings import Settings, validated

_PLACE_OF_WEIGHTS = {"model_size", "weights", "weights_dir", "weights_dirs", "weights_sha256"}
"""Settings that say where the model is, not which one it is."""


class Plan(BaseModel):
    """The model, the settings and the options for all recordings, and the folder of its results."""

    model_config = ConfigDict(frozen=True)

    output: Path
    weights: str
    weights_sha256: str
    calibration_sha256: str | None = None
    """Digest of the calibration beside the weights, if it may lead to int8."""
    settings: dict[str, object]
    runtime: str
    """The runtime that is set, or that the first worker has chosen; likewise the precision."""
    precision: str
    topic: str | None
    node: str
    images: bool
    masks: bool
    suffix: str = ""
    """The format of the results in FORMATS; "": recordings become recordings, and videos JSON lines."""
    crops: bool = False

    @property
    def is_open(self) -> bool:
        """Whether runtime or precision depend on what is measured."""
        return self.runtime == "auto" or (self.precision == "auto" and self.calibration_sha256 is not None)

    @property
    def settings_sha256(self) -> str:
        """Digest of everything but model and recording that the results depend on."""
        settings = {name: value for name, value in self.settings.items() if name not in _PLACE_OF_WEIGHTS}
        options: dict[str, object] = {"topic": self.topic, "node": self.node}
        options |= {"images": self.images, "masks": self.masks}
        # Without them, the digest equals that of results from before formats and crops were introduced.
        further = {"suffix": self.suffix, "crops": self.crops}
        options |= {name: value for name, value in further.items() if value}
        # Likewise without a calibration.
        calibration = [self.calibration_sha256] if self.calibration_sha256 else []
        text = json.dumps([settings, options, *calibration], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def model_settings(self) -> Settings:
        """The settings with this model, runtime and precision."""
        chosen = {
            "weights": self.weights,
            "weights_sha256": self.weights_sha256,
            "runtime": self.runtime,
            "precision": self.precision,
        }
        return validated({**self.settings, **chosen})


def plan_of(
    settings: Settings,
    *,
    output: Path,
    topic: str | None,
    node: str,
    images: bool,
    masks: bool,
    suffix: str = "",
    crops: bool = False,
) -> Plan:
    """The plan for the model that `settings` select, as its file is now; raises WeightsError and OSError."""
    weights = Path(os.path.abspath(weights_path(settings)))  # noqa: PTH100
    digest = weights_digest(weights, sha256=settings.weights_sha256)
    return Plan(
        output=output,
        weights=str(weights),
        weights_sha256=digest,
        calibration_sha256=calibration_digest(weights, precision=settings.precision, device=settings.device),
        settings=settings.model_dump(mode="json"),
        runtime=settings.runtime,
        precision=settings.precision,
        topic=topic,
        node=node,
        images=images,
        masks=masks,
        suffix=suffix,
        crops=crops,
    )
