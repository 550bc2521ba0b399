"""Networks in int8: as good as in fp32, cached apart from it, and refused with the command that helps."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnx
import pytest
from support.colcon_workspace import REPOSITORY
from support.random_model import random_frame, random_model

from tools.shapes.evaluate import UNSEEN_SEED, evaluate, moving, stills
from yolov5_lifecycle import load_model
from yolov5_lifecycle.checkpoints.locate import WeightsFile, load_weights
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.detection.prepared_model import load_detector, prepare_model
from yolov5_lifecycle.models.model import WeightsError
from yolov5_lifecycle.models.network import fuse
from yolov5_lifecycle.quantization.calibration_file import (
    Calibration,
    path_beside,
    read_calibration,
    write_calibration,
)
from yolov5_lifecycle.runtimes.onnx_graph import onnx_graph
from yolov5_lifecycle.runtimes.processor import abilities, has_bf16
from yolov5_lifecycle.runtimes.quantization import Activation, Quantization, QuantizationError, convolutions
from yolov5_lifecycle.runtimes.registry import installed_runtimes, load_runtime
from yolov5_lifecycle.runtimes.torch_device import DeviceError
from yolov5_lifecycle.settings.settings import Settings, validated

SHAPES = REPOSITORY / "weights" / "shapes.safetensors"
SIZES_HW = [(64, 96)]
pytestmark = pytest.mark.skipif("openvino" not in installed_runtimes(), reason="no openvino: make install")


@pytest.fixture(scope="module")
def weights() -> WeightsFile:
    return load_weights(SHAPES)


@pytest.fixture(scope="module")
def calibration(weights: WeightsFile) -> Calibration:
    return read_calibration(path_beside(SHAPES))


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """A copy of the weights alone, in the test's own folder."""
    return Path(shutil.copy(SHAPES, tmp_path / "best.safetensors"))


@pytest.mark.long
@pytest.mark.parametrize(
    ("image_size", "images"),
    [
        pytest.param(320, lambda: stills(UNSEEN_SEED, 60, (256, 320)), id="stills at 320"),
        pytest.param(640, lambda: moving(UNSEEN_SEED, 200, (480, 640)), id="moving at 640"),
    ],
)
def test_shapes_are_found_in_int8_as_well_as_in_fp32(
    image_size: int, images: Callable[[], Any], weights: WeightsFile, calibration: Calibration
) -> None:
    figures = {}
    for precision in ("fp32", "int8"):
        detector = load_detector(
            weights.model,
            device="cpu",
            runtime="openvino",
            precision=precision,
            image_size=image_size,
            quantization=calibration,
        )
        assert detector.runtime.precision == precision
        figures[precision] = evaluate(detector, images())
        detector.close()
    assert figures["int8"].precision >= figures["fp32"].precision - 0.01
    assert figures["int8"].recall >= figures["fp32"].recall - 0.01


def of_ranges(high: float, *, in_fp32: bool = False) -> Quantization:
    """All activations of the random model have the range from -1 to `high`."""
    found = convolutions(fuse(random_model().network()))
    read = {path: Activation((-1.0, high), (0.0,) * each.in_channels) for path, each in found.items()}
    return Quantization.of(read, read if in_fp32 else ())


def test_what_is_predicted_depends_on_the_ranges_and_on_the_layers_in_fp32() -> None:
    found = []
    for quantization in (None, of_ranges(2.0, in_fp32=True), of_ranges(2.0), of_ranges(20.0)):
        precision = "fp32" if quantization is None else "int8"
        runtime = load_runtime(
            random_model(), "openvino", device="cpu", precision=precision, quantization=quantization
        )
        found.append(runtime(random_frame(), "rgb").rows.tobytes())
        runtime.close()
    assert found[0] == found[1]
    assert len(set(found)) == 3


@pytest.mark.parametrize(("bits", "largest"), [(8, 127), (7, 63)])
def test_weights_have_as_many_bits_as_the_processor_multiplies_exactly(
    bits: int, largest: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("yolov5_lifecycle.runtimes.onnx_graph.weight_bits", lambda _: bits)
    graph = onnx.ModelProto.FromString(onnx_graph(fuse(random_model().network()), (64, 96), of_ranges(2.0)))
    integers = [each for each in graph.graph.initializer if each.data_type == onnx.TensorProto.INT8]
    assert max(abs(onnx.numpy_helper.to_array(each).astype(int)).max() for each in integers) == largest


@pytest.mark.parametrize("runtime", ["torch", "onnxruntime"])
@pytest.mark.parametrize("precision", ["int8", "bf16"])
def test_other_runtimes_refuse_what_they_compute_slowly(runtime: str, precision: str) -> None:
    with pytest.raises(DeviceError, match=f"'{precision}' needs runtime 'openvino', found '{runtime}'"):
        load_runtime(random_model(), runtime, device="cpu", precision=precision)


def test_int8_without_ranges_or_with_those_of_another_model_is_refused() -> None:
    with pytest.raises(QuantizationError, match="needs a calibration"):
        load_runtime(random_model(), "openvino", device="cpu", precision="int8")
    quantization = Quantization.of({"elsewhere": Activation((0.0, 1.0), (0.0,))})
    with pytest.raises(QuantizationError, match="do not match this network's"):
        load_runtime(random_model(), "openvino", device="cpu", precision="int8", quantization=quantization)


@pytest.mark.skipif(has_bf16(abilities()), reason="this processor multiplies bfloat16")
def test_bf16_is_refused_where_the_processor_emulates_it() -> None:
    with pytest.raises(
        DeviceError, match=r"'bf16' needs a processor with AVX512-BF16 or AMX, found one with"
    ):
        load_runtime(random_model(), "openvino", device="cpu", precision="bf16")


@pytest.mark.skipif(not has_bf16(abilities()), reason="no AVX512-BF16 and no AMX here")
def test_bf16_finds_the_shapes(weights: WeightsFile) -> None:
    detector = load_detector(weights.model, device="cpu", precision="bf16", image_size=320)
    assert (detector.runtime.name, detector.runtime.precision) == ("openvino", "bf16")
    assert evaluate(detector, stills(UNSEEN_SEED, 50, (256, 320))).recall >= 0.9


def of_other_weights(copied: Path, calibration: Calibration) -> None:
    write_calibration(path_beside(copied), calibration)
    write_safetensors(random_model(), copied)


def lacking_a_convolution(copied: Path, calibration: Calibration) -> None:
    ranges, means = ({**each} for each in (calibration.ranges, calibration.means))
    del ranges["model.0.conv"], means["model.0.conv"]
    changed = {"ranges": ranges, "means": means, "image_size": 64}
    write_calibration(path_beside(copied), calibration.model_copy(update=changed))


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        pytest.param(lambda *_: None, "calibration not found", id="none"),
        pytest.param(
            lambda copied, found: write_calibration(path_beside(copied), found),
            "for image_size 640, not 64",
            id="another size",
        ),
        pytest.param(of_other_weights, "made for other weights", id="other weights"),
        pytest.param(lacking_a_convolution, r"convolutions: model\.0\.conv", id="a layer is missing"),
    ],
)
def test_int8_without_a_calibration_that_fits_is_refused_with_the_command_to_type(
    make: Callable[[Path, Calibration], None], reason: str, copied: Path, calibration: Calibration
) -> None:
    make(copied, calibration)
    with pytest.raises(QuantizationError, match=rf"{reason}.*`calibrate {copied} DATA --image-size 64`"):
        load_model(copied, precision="int8", device="cpu", image_size=64)


def test_a_calibration_outside_the_allowed_folders_is_refused(copied: Path) -> None:
    path_beside(copied).symlink_to(path_beside(SHAPES))
    settings = Settings(weights=str(copied), weights_dirs=(str(copied.parent),), image_size=64, device="cpu")
    with pytest.raises(WeightsError, match="does not lie in a folder"):
        prepare_model(settings.model_copy(update={"precision": "int8"}), SIZES_HW)


@pytest.mark.long
@pytest.mark.parametrize(
    ("runtime", "precision", "choice", "used"),
    [
        pytest.param("auto", "int8", "the only one for int8", "int8", id="int8"),
        pytest.param("openvino", "auto", "as set", "fp32", id="auto"),
    ],
)
def test_int8_is_used_where_it_is_asked_for_and_auto_is_fp32(
    runtime: str, precision: str, choice: str, used: str, copied: Path, calibration: Calibration
) -> None:
    write_calibration(path_beside(copied), calibration.model_copy(update={"image_size": 64}))
    wanted = {"weights": str(copied), "image_size": 64, "device": "cpu"}
    model = prepare_model(validated(wanted | {"runtime": runtime, "precision": precision}), SIZES_HW)
    facts = [model.facts[name] for name in ("runtime", "runtime choice", "precision")]
    assert facts == ["openvino", choice, used]
    model.close()
