"""The package as a library: three names, the settings of the node, and no ROS."""

from __future__ import annotations

import inspect
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support.colcon_workspace import REPOSITORY
from support.pages import README, blocks
from support.random_model import random_frame
from support.small_families import segmentation_checkpoint
from support.started import printed_by

import yolov5_lifecycle
from yolov5_lifecycle import Detections, Detector, load_model
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.images.region import BoxFilter, Region
from yolov5_lifecycle.models.model import WeightsError
from yolov5_lifecycle.settings.schema import SettingsError
from yolov5_lifecycle.settings.settings import SETTINGS_BY_NAME
from yolov5_lifecycle.sources.scene import CLASS_NAMES

WEIGHTS = REPOSITORY / "weights" / "shapes.safetensors"
IMAGE = REPOSITORY / "docs" / "images" / "shapes.jpg"
SHOWN = Counter(circle=1, square=2, triangle=1, star=2)
"""What is to be seen in the image."""

WIDER: dict[str, object] = {"device": str | int, "classes": Sequence[str | int]}
"""Types of settings for which an integer is a usual value."""


@pytest.fixture(scope="module")
def image() -> NDArray[np.uint8]:
    return np.asarray(cv2.imread(str(IMAGE)), np.uint8)


@pytest.fixture(scope="module")
def detector() -> Iterator[Detector]:
    detector = load_model(WEIGHTS, device="cpu", runtime="torch")
    yield detector
    detector.close()


def names(detections: Detections) -> Counter[str]:
    return Counter(found.class_name for found in detections.objects(CLASS_NAMES))


def without_ros(program: str) -> str:
    """What `program` prints in a clone of the repository, where rclpy cannot be imported."""
    return printed_by(f"import sys\nsys.modules['rclpy'] = None\n{program}", cwd=REPOSITORY)


@pytest.mark.end_to_end
def test_the_readme_detects_in_an_image_without_ros() -> None:
    (program,) = blocks(README, "python")
    lines = without_ros(program).splitlines()
    assert Counter(line.partition(" ")[0] for line in lines) == SHOWN


@pytest.mark.long
def test_the_page_on_python_detects_what_it_asks_for() -> None:
    program, prepared = blocks(REPOSITORY / "docs" / "python.md", "python")
    lines = without_ros(prepared + program).splitlines()
    assert Counter(line.partition(" ")[0] for line in lines) == Counter(circle=1, star=2)


@pytest.mark.long
def test_the_page_on_masks_gives_labels_and_masks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = blocks(REPOSITORY / "docs" / "masks.md", "python")[-1]
    (tmp_path / "yolov5n-seg.pt").write_bytes(segmentation_checkpoint())
    cv2.imwrite(str(tmp_path / "image.jpg"), random_frame(75, 100))
    monkeypatch.chdir(tmp_path)
    found: dict[str, Any] = {}
    exec(program, found)
    labels, mask = found["labels"], found["mask"]
    assert (labels.shape, labels.dtype, mask.dtype) == ((75, 100), np.uint16, np.bool_)
    assert labels.any()


def test_the_public_names_are_listed_and_no_other_is_there() -> None:
    public = ["Detections", "Detector", "load_model"]
    assert yolov5_lifecycle.__all__ == public
    assert set(public) <= set(dir(yolov5_lifecycle))
    with pytest.raises(AttributeError, match="'yolov5_lifecycle' has no attribute 'load_modell'"):
        yolov5_lifecycle.load_modell  # noqa: B018 - the attribute is what is tried


def test_a_keyword_is_a_setting_with_its_type_and_default() -> None:
    weights, *keywords = inspect.signature(load_model, eval_str=True).parameters.values()
    assert weights.name == "weights"
    for keyword in keywords:
        setting = SETTINGS_BY_NAME[keyword.name]
        usual = Sequence[str] if setting.type is tuple else setting.type
        assert keyword.annotation == WIDER.get(setting.name, usual)
        assert (keyword.default, type(keyword.default)) == (setting.default, setting.type)


def test_an_image_is_detected_in_either_order_of_colours(
    detector: Detector, image: NDArray[np.uint8]
) -> None:
    found = detector(image)
    assert names(found) == SHOWN
    turned = detector(image[..., ::-1], channel_order="rgb")
    np.testing.assert_allclose(found.scores, turned.scores, rtol=1e-5)
    with pytest.raises(ImageError, match="Expected 'bgr' or 'rgb' as channel_order, found 'RGB'"):
        detector(image, channel_order="RGB")  # type: ignore[arg-type]  # a mistake


def test_the_selection_of_a_loaded_model_may_be_replaced(
    detector: Detector, image: NDArray[np.uint8]
) -> None:
    usual = detector.selection
    assert usual == Selection()
    try:
        detector.selection = replace(usual, max_detections=1)
        assert len(detector(image)) == 1
    finally:
        detector.selection = usual


def test_the_settings_are_those_that_were_given() -> None:
    detector = load_model(
        str(WEIGHTS),
        device="cpu",
        runtime="torch",
        precision="fp32",
        image_size=320,
        confidence_threshold=1,
        iou_threshold=0.5,
        max_detections=7,
        classes=("circle", 3),
        class_thresholds=("circle: 0.5", "3: 0.75"),
        regions=["0,0 1,0 1,1"],
        ignore_regions=("0,0 0.5,0 0.5,1",),
        region_anchor="foot",
        min_box_size=9,
        max_box_size=0.5,
        agnostic_nms=True,
    )
    assert (detector.image_size, detector.runtime.name, detector.class_names) == (320, "torch", CLASS_NAMES)
    assert detector.selection == Selection(
        confidence_threshold=1.0,
        iou_threshold=0.5,
        max_detections=7,
        classes=frozenset({0, 3}),
        class_thresholds=((0, 0.5), (3, 0.75)),
        agnostic_nms=True,
        box_filter=BoxFilter(
            regions=(Region.parse("0,0 1,0 1,1"),),
            ignore_regions=(Region.parse("0,0 0.5,0 0.5,1"),),
            region_anchor="foot",
            min_box_size=9.0,
            max_box_size=0.5,
        ),
    )


@pytest.mark.parametrize(
    ("settings", "error", "told"),
    [
        pytest.param({"weights": "absent.pt"}, WeightsError, "absent.pt", id="missing-file"),
        pytest.param(
            {"device": "gpu", "confidence_threshold": 25, "image_size": True},
            SettingsError,
            "(?s)Did you mean 'cuda'.*image_size: true is not an integer.*confidence_threshold: 25.0 is not",
            id="every-wrong-value",
        ),
        pytest.param({"classes": ["circel"]}, SettingsError, "Did you mean 'circle'?", id="unknown-class"),
    ],
)
def test_what_cannot_be_loaded_is_refused(
    settings: dict[str, Any], error: type[Exception], told: str
) -> None:
    values = {"weights": WEIGHTS, "device": "cpu", "runtime": "torch", **settings}
    with pytest.raises(error, match=told):
        load_model(**values)
