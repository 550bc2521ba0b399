"""A calibration that is intact and absurd is noticed when the model is loaded; an honest one never is."""

from __future__ import annotations

import dataclasses
import logging
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.calibrations import a_calibration, calibration_at
from support.colcon_workspace import REPOSITORY
from support.random_model import TINY, TINY_SEGMENT, random_model
from support.small_families import SMALL_FAMILIES

from tools.shapes.evaluate import UNSEEN_SEED, evaluate, stills
from yolov5_lifecycle import load_model
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW
from yolov5_lifecycle.detection.letterbox import Letterbox
from yolov5_lifecycle.detection.prepared_model import PreparedModel, prepare_model
from yolov5_lifecycle.models.architecture import Architecture
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.models.network import fuse
from yolov5_lifecycle.quantization.activation_ranges import activations, network_pixels
from yolov5_lifecycle.quantization.calibration_file import (
    Calibration,
    CalibrationError,
    path_beside,
    write_calibration,
)
from yolov5_lifecycle.quantization.comparison import (
    MAX_CARD_NOISE,
    MAX_INPUT_NOISE,
    MAX_NOISE,
    Fp32Network,
    deviation,
)
from yolov5_lifecycle.quantization.precision_choice import choice_of
from yolov5_lifecycle.quantization.reference import Reference, contrast_card
from yolov5_lifecycle.runtimes.auto import choice_key, computer_digest, write_figures
from yolov5_lifecycle.runtimes.cache import cache_folder
from yolov5_lifecycle.runtimes.processor_abilities import abilities, weight_bits
from yolov5_lifecycle.runtimes.quantization import Activation, Quantization
from yolov5_lifecycle.runtimes.registry import installed_runtimes, load_runtime
from yolov5_lifecycle.runtimes.speed import INT8_FIGURES
from yolov5_lifecycle.settings.settings import Settings

SHAPES = REPOSITORY / "weights" / "shapes.safetensors"
IMAGE_SIZE = 320
FRAME_HW = (256, 320)
ONE_LAYER = "model.8.cv2.conv"
"""In it int8 changes the predictions least: the coarsest level by 6 % of its variance."""
Change = Callable[[str, Activation], Activation]
pytestmark = pytest.mark.skipif("openvino" not in installed_runtimes(), reason="no openvino: make install")


@pytest.fixture(scope="module")
def honest() -> Calibration:
    """That of the shapes, as if made here at IMAGE_SIZE."""
    changed = {"image_size": IMAGE_SIZE, "weight_bits": weight_bits(abilities())}
    return calibration_at(path_beside(SHAPES)).model_copy(update=changed)


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    return Path(shutil.copy(SHAPES, tmp_path / "best.safetensors"))


def to_range(low: float, high: float) -> Change:
    return lambda _, read: Activation((low, high), read.means)


def only(path: str, change: Change) -> Change:
    return lambda name, read: change(name, read) if name == path else read


def changed(calibration: Calibration, change: Change) -> Calibration:
    read = {name: change(name, each) for name, each in calibration.quantization.activations.items()}
    return of_activations(calibration, read)


def of_activations(calibration: Calibration, read: dict[str, Activation]) -> Calibration:
    ranges, means = ({name: getattr(each, of) for name, each in read.items()} for of in ("range", "means"))
    return calibration.model_copy(update={"ranges": ranges, "means": means})


def upside_down(calibration: Calibration) -> Calibration:
    """Each convolution has the range of another one, the first that of the last; means are clipped to it."""
    read = calibration.quantization.activations
    others = dict(zip(read, reversed(list(read.values())), strict=True))
    return of_activations(
        calibration,
        {
            name: Activation(others[name].range, tuple(np.clip(each.means, *others[name].range).tolist()))
            for name, each in read.items()
        },
    )


def with_reference_of_nothing(calibration: Calibration) -> Calibration:
    """Everything is rounded to zero, and the reference is black and claims that this is usual."""
    return changed(calibration, to_range(-1e9, 1e9)).model_copy(update={"reference": black_reference()})


def made_from_nothing(calibration: Calibration) -> Calibration:
    """Ranges of a black image, of pixels up to 0.001: on that int8 is as good as fp32, on others blind."""
    network = fuse(load_weights(SHAPES).model.network())
    black = network_pixels(np.zeros((*FRAME_HW, 3), np.uint8), "rgb", 3)
    read = activations(network, [black], progress=lambda _: None)
    read["model.0.conv"] = Activation((0.0, 0.001), read["model.0.conv"].means)
    return of_activations(calibration, read).model_copy(update={"reference": black_reference()})


def black_reference() -> Reference:
    """Which claims that int8 differs as much as may be."""
    grey = a_calibration().reference
    return grey.model_copy(update={"rgb": "A" * 256, "noise": (MAX_NOISE,) * len(grey.noise)})


ABSURD: dict[str, Callable[[Calibration], Calibration]] = {
    "ranges of 1e9": lambda found: changed(found, to_range(-1e9, 1e9)),
    "ranges of 1e6": lambda found: changed(found, to_range(-1e6, 1e6)),
    "tiny ranges": lambda found: changed(found, to_range(-1e-5, 1e-5)),
    "the smallest ranges": lambda found: changed(found, to_range(0.0, 1e-6)),
    "wide ranges and means of 1e9": lambda found: changed(
        found, lambda _, read: Activation((-1e9, 1e9), (1e9,) * len(read.means))
    ),
    "means of 1e9": lambda found: changed(
        found, lambda _, read: Activation(read.range, (1e9,) * len(read.means))
    ),
    "means of 1e9 in one layer": lambda found: changed(
        found, only(ONE_LAYER, lambda _, read: Activation(read.range, (1e9,) * len(read.means)))
    ),
    "one layer of 1e9": lambda found: changed(found, only(ONE_LAYER, to_range(-1e9, 1e9))),
    "one tiny layer": lambda found: changed(found, only(ONE_LAYER, to_range(-1e-5, 1e-5))),
    "a first layer of 1e9": lambda found: changed(found, only("model.0.conv", to_range(0.0, 1e9))),
    "ranges for negative values": lambda found: changed(
        found, lambda _, read: Activation((-read.range[1], 0.0), (0.0,) * len(read.means))
    ),
    "ranges sixteen times as wide": lambda found: changed(
        found, lambda _, read: Activation((16 * read.range[0], 16 * read.range[1]), read.means)
    ),
    "a quarter of the ranges": lambda found: changed(
        found,
        lambda _, read: Activation(
            (read.range[0] / 4, read.range[1] / 4),
            tuple(np.clip(read.means, read.range[0] / 4, read.range[1] / 4).tolist()),
        ),
    ),
    "swapped layers": upside_down,
    "a reference that shows nothing": with_reference_of_nothing,
    "ranges and reference of the dark": made_from_nothing,
    "a reference of another network": lambda found: found.model_copy(
        update={"reference": found.reference.model_copy(update={"noise": (0.01,)})}
    ),
}


_SOON = (
    "ranges of 1e9",
    "tiny ranges",
    "one layer of 1e9",
)


def cases(*soon: str) -> list[Any]:
    """Those of ABSURD, all but `soon` long."""
    return [
        pytest.param(spoil, id=name, marks=() if name in soon else pytest.mark.long)
        for name, spoil in ABSURD.items()
    ]


def is_fast(model: Model, calibration: Calibration) -> None:
    """Claim in the cache that int8 is fast here."""
    frame_hw = Letterbox.fit(USUAL_SOURCE_HW, image_size=IMAGE_SIZE, stride=32).network_hw
    digest = calibration.quantization.digest
    key = choice_key(model, installed_runtimes(), frame_hw, "int8", "openvino", digest)
    figures_ms = dict(zip(INT8_FIGURES, (20.0, 1.0, 40.0, 2.0), strict=True))
    assert write_figures(cache_folder("choices") / f"{key}.json", figures_ms) == ""


def prepared(weights: Path, calibration: Calibration) -> PreparedModel:
    calibration = calibration.model_copy(update={"computer_sha256": "0" * 64})
    write_calibration(path_beside(weights), calibration)
    is_fast(load_weights(weights).model, calibration)
    settings = Settings(weights=str(weights), image_size=IMAGE_SIZE, device="cpu", runtime="openvino")
    return prepare_model(settings, [FRAME_HW])


def recall(model: PreparedModel) -> float:
    found = evaluate(model.detector, stills(UNSEEN_SEED, 10, FRAME_HW)).recall
    model.close()
    return found


@pytest.mark.long
@pytest.mark.parametrize("spoilt", cases(*_SOON))
def test_auto_uses_fp32_instead_of_an_absurd_calibration_and_says_why(
    spoilt: Callable[[Calibration], Calibration],
    honest: Calibration,
    weights: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level(logging.WARNING):
        model = prepared(weights, spoilt(honest))
    assert (model.facts["precision"], model.facts["runtime"]) == ("fp32", "openvino")
    reason = model.facts["precision choice"]
    assert reason.startswith(("the calibration is not usable: ", "int8 is not considered: "))
    assert any(record.getMessage().endswith(reason.partition(": ")[2]) for record in caplog.records)
    assert recall(model) >= 0.9


@pytest.mark.long
@pytest.mark.parametrize("spoilt", cases("ranges of 1e9"))
def test_int8_with_an_absurd_calibration_is_refused_with_the_command_to_type(
    spoilt: Callable[[Calibration], Calibration], honest: Calibration, weights: Path
) -> None:
    write_calibration(path_beside(weights), spoilt(honest))
    with pytest.raises(CalibrationError, match=rf"usable.*`calibrate {weights} DATA`") as refusal:
        load_model(weights, precision="int8", device="cpu", image_size=IMAGE_SIZE)
    assert str(refusal.value).startswith(f"{path_beside(weights)}: ")


@pytest.mark.long
def test_auto_uses_int8_with_an_honest_calibration(honest: Calibration, weights: Path) -> None:
    model = prepared(weights, honest)
    assert model.facts["precision"] == "int8"
    assert recall(model) >= 0.9


@pytest.mark.long
@pytest.mark.parametrize("image_size", [64, 320, pytest.param(640, marks=pytest.mark.long)])
def test_int8_with_an_honest_calibration_is_used_at_every_size(image_size: int) -> None:
    detector = load_model(SHAPES, precision="int8", device="cpu", image_size=image_size)
    assert detector.runtime.precision == "int8"
    detector.close()


def photograph(seed: int, hw: tuple[int, int]) -> np.ndarray:
    """Blurred noise with the spectrum of a photograph: much in the coarse, little in the fine."""
    rng = np.random.default_rng(seed)
    whole = np.zeros((*hw, 3))
    for cells in (3, 6, 12, 24, 48):
        coarse = rng.normal(0, 200 / cells, (cells, cells, 3))
        whole += cv2.resize(coarse, hw[::-1], interpolation=cv2.INTER_CUBIC)
    return np.clip(whole + 114, 0, 255).astype(np.uint8)


FAMILIES: dict[str, Architecture] = {"tiny": TINY, "tiny with masks": TINY_SEGMENT} | {
    name: dataclasses.replace(each, classes=3) for name, each in SMALL_FAMILIES.items()
}


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
@pytest.mark.parametrize(
    "architecture",
    [
        pytest.param(each, id=name, marks=() if name in ("tiny", "ghost") else pytest.mark.long)
        for name, each in FAMILIES.items()
    ],
)
def test_the_noise_of_an_honest_calibration_of_a_random_network_is_below_the_limits(
    architecture: Architecture, seed: int
) -> None:
    model = random_model(seed, architecture)
    frames = [network_pixels(photograph(number, FRAME_HW), "rgb", 3) for number in range(8)]
    read = activations(fuse(model.network()), frames, progress=lambda _: None)
    quantization = Quantization(read, frozenset(), weight_bits(abilities()))
    int8 = load_runtime(model, "openvino", device="cpu", precision="int8", quantization=quantization)
    network = Fp32Network(model)
    for frame, limit in ((photograph(99, FRAME_HW), MAX_NOISE), (contrast_card(FRAME_HW), MAX_CARD_NOISE)):
        found = network.compare(int8, read, frame)
        assert max(found.levels) < 0.8 * limit
        assert max(found.inputs.values()) < 0.8 * MAX_INPUT_NOISE
    int8.close()


@pytest.mark.long
def test_the_official_yolov5n_is_compared_without_complaint(reference_dir: Path) -> None:
    weights = load_weights(reference_dir / "weights" / "yolov5n.pt")
    photo = cv2.imread(str(reference_dir / "images" / "bus.jpg"))[..., ::-1]
    crops = [photo[top : top + 600, left : left + 800] for top in (0, 240, 480) for left in (0, 10)]
    frames = [np.ascontiguousarray(cv2.resize(crop, FRAME_HW[::-1])) for crop in crops]
    pixels = [network_pixels(frame, "rgb", 3) for frame in frames]
    read = activations(fuse(weights.model.network()), pixels, progress=lambda _: None)
    for bits in (7, 8):
        quantization = Quantization(read, frozenset(), bits)
        int8 = load_runtime(
            weights.model, "openvino", device="cpu", precision="int8", quantization=quantization
        )
        network = Fp32Network(weights.model)
        for frame, limit in ((frames[2], MAX_NOISE), (contrast_card(FRAME_HW), MAX_CARD_NOISE)):
            assert max(network.compare(int8, read, frame).levels) < 0.6 * limit
        int8.close()


def test_the_reference_is_enlarged_to_the_input_of_the_network(honest: Calibration) -> None:
    frame = honest.reference.frame(FRAME_HW)
    assert frame.shape == (*FRAME_HW, 3)
    assert frame.dtype == np.uint8
    assert frame.std() > 10
    assert Reference.model_validate_json(honest.reference.model_dump_json()) == honest.reference


def test_the_generated_image_is_always_the_same() -> None:
    assert (contrast_card(FRAME_HW) == contrast_card(FRAME_HW)).all()
    assert contrast_card((64, 64)).shape == (64, 64, 3)
    assert contrast_card(FRAME_HW).std() > 60


@pytest.mark.long
def test_an_honest_calibration_has_no_deviation(honest: Calibration) -> None:
    model = load_weights(SHAPES).model
    int8 = load_runtime(model, "openvino", device="cpu", precision="int8", quantization=honest.quantization)
    assert deviation(model, honest, int8, FRAME_HW) == ""
    int8.close()


@pytest.mark.long
@pytest.mark.parametrize(
    ("int8_ms", "precision"),
    [pytest.param(1.0, "int8", id="faster"), pytest.param(1e5, "fp32", id="slower")],
)
def test_auto_chooses_what_calibrate_measured_here_and_told(
    int8_ms: float, precision: str, honest: Calibration, weights: Path
) -> None:
    changes = {"ms_per_image": int8_ms, "processor_ms_per_image": int8_ms}
    measured = tuple(
        each.model_copy(update=changes) if each.precision == "int8" else each for each in honest.measured
    )
    calibration = honest.model_copy(update={"measured": measured, "computer_sha256": computer_digest()})
    write_calibration(path_beside(weights), calibration)
    is_fast(load_weights(weights).model, calibration)
    settings = Settings(weights=str(weights), image_size=IMAGE_SIZE, device="cpu", runtime="openvino")
    model = prepare_model(settings, [FRAME_HW])
    assert model.facts["precision"] == precision
    assert model.facts["precision choice"] == choice_of(calibration, "openvino").reason
    model.close()
