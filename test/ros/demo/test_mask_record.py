"""How the demo compares masks with the ground truth."""

from __future__ import annotations

import numpy as np
import pytest
from sensor_msgs.msg import Image

from yolov5_lifecycle.ros.demo.ground_truth import Sighting
from yolov5_lifecycle.ros.demo.mask_record import Labels, labels_of_message, mask_ious
from yolov5_lifecycle.ros.demo.outcome import DemonstrationError

LEFT, RIGHT = (0.0, 0.0, 10.0, 8.0), (10.0, 0.0, 20.0, 8.0)


def _sighting(*objects: tuple[str, tuple[float, ...]]) -> Sighting:
    names = tuple(name for name, _ in objects)
    boxes = np.array([box for _, box in objects], np.float64).reshape(-1, 4)
    return Sighting(0, 0.0, names, (0.9,) * len(names), boxes)


def _labels(**columns: slice) -> Labels:
    """An image with a label, written behind `of_`, in each of these columns."""
    labels = np.zeros((8, 20), np.uint16)
    for name, part in columns.items():
        labels[:, part] = int(name.removeprefix("of_"))
    return labels


TRUTH = _sighting(("circle", LEFT), ("star", RIGHT))
TRUE = _labels(of_1=slice(0, 10), of_2=slice(10, 20))


@pytest.mark.parametrize(
    ("seen", "found", "ious"),
    [
        pytest.param(TRUTH, TRUE, [1.0, 1.0], id="the same"),
        pytest.param(
            _sighting(("star", RIGHT), ("circle", LEFT)),
            _labels(of_1=slice(10, 20), of_2=slice(0, 10)),
            [1.0, 1.0],
            id="in another order",
        ),
        pytest.param(
            TRUTH, _labels(of_1=slice(0, 15), of_2=slice(15, 20)), [10 / 15, 0.5], id="another border"
        ),
        pytest.param(TRUTH, _labels(), [0.0, 0.0], id="no pixels"),
        pytest.param(_sighting(("star", RIGHT)), _labels(of_1=slice(10, 20)), [1.0], id="one missed"),
        pytest.param(_sighting(("square", LEFT)), _labels(of_1=slice(0, 10)), [], id="another class"),
        pytest.param(_sighting(), _labels(), [], id="nothing found"),
    ],
)
def test_the_pixels_of_objects_that_belong_together_are_compared(
    seen: Sighting, found: Labels, ious: list[float]
) -> None:
    assert sorted(mask_ious(seen, found, TRUTH, TRUE)) == pytest.approx(sorted(ious))


def test_masks_of_another_size_are_a_failure() -> None:
    with pytest.raises(DemonstrationError, match=r"expected masks of \(8, 20\).*found \(4, 20\)"):
        mask_ious(TRUTH, TRUE[:4], TRUTH, TRUE)


@pytest.mark.parametrize("is_bigendian", [0, 1])
def test_labels_are_read_in_either_byte_order_without_the_padding_of_rows(is_bigendian: int) -> None:
    padded = np.arange(0, 8000, 1000).reshape(2, 4).astype(">u2" if is_bigendian else "<u2")
    message = Image(height=2, width=3, encoding="16UC1", is_bigendian=is_bigendian, step=8)
    message.data = padded.tobytes()
    np.testing.assert_array_equal(labels_of_message(message), [[0, 1000, 2000], [4000, 5000, 6000]])


def test_another_encoding_is_a_failure() -> None:
    with pytest.raises(DemonstrationError, match="expected masks in the encoding 16UC1, found mono8"):
        labels_of_message(Image(height=1, width=1, encoding="mono8", step=1))
