"""The page on masks: what it tells a reader to type works, and its numbers are those of the code."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.camera_client import CameraClient
from support.colcon_workspace import REPOSITORY
from support.pages import blocks
from support.preparations import Preparations
from support.random_model import random_frame
from support.segmented_scene import PARAMETERS, SIZE_HW, MasksSubscriber, SegmentingModel, labels
from support.served_node import ServedNode
from support.small_families import segmentation_checkpoint

PAGE = REPOSITORY / "docs" / "masks.md"
IN_NODE, _, WITHOUT_ROS = blocks(PAGE, "python")


@pytest.fixture
def served(prepare: Preparations) -> Iterator[ServedNode]:
    SegmentingModel(prepare)
    with ServedNode(prepare, parameters=PARAMETERS) as served:
        served.bring_to("active")
        yield served


def test_a_subscriber_as_on_the_page_counts_the_pixels_of_each_object(
    served: ServedNode, capsys: pytest.CaptureFixture[str]
) -> None:
    masks = MasksSubscriber(CameraClient(served, size_hw=SIZE_HW))
    masks.begin()
    array, message = masks.segment()
    names: dict[str, object] = {}
    exec(IN_NODE, names)
    capsys.readouterr()
    names["on_both"](array, message)  # type: ignore[operator]  # a function of the page
    counts = [int((labels() == value).sum()) for value in (1, 2)]
    assert capsys.readouterr().out == f"cat  {counts[0]} pixels\ndog  {counts[1]} pixels\n"


@pytest.mark.long
def test_the_example_without_ros_gives_masks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "yolov5n-seg.pt").write_bytes(segmentation_checkpoint())
    cv2.imwrite(str(tmp_path / "image.jpg"), random_frame(75, 100))
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(WITHOUT_ROS, names)
    found, mask = names["labels"], names["mask"]
    assert isinstance(found, np.ndarray)
    assert isinstance(mask, np.ndarray)
    assert (found.shape, found.dtype, mask.dtype) == ((75, 100), np.uint16, np.bool_)
    assert found.any()
