"""Checkpoints that YOLOv5 writes become the models that they hold."""

from __future__ import annotations

import dataclasses
import datetime
import io
import itertools
import threading
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path, PosixPath
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from support.checkpoint_builder import (
    SMALL,
    foreign,
    head,
    in_one_storage,
    layers_of,
    modules_of,
    official_model,
    saved,
    stripped,
)
from support.random_model import CLASS_NAMES, TINY, random_network
from support.small_families import SMALL_FAMILIES
from torch.nn.utils import prune

from yolov5_lifecycle.checkpoints import pt_file as checkpoint
from yolov5_lifecycle.checkpoints.archive import Archive
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.checkpoints.pt_file import read_checkpoint
from yolov5_lifecycle.checkpoints.safetensors_file import read_safetensors, write_safetensors
from yolov5_lifecycle.models.architecture import SIZES, Architecture, Layer
from yolov5_lifecycle.models.model import Model, WeightsError
from yolov5_lifecycle.models.network import Network

TINY_N6 = dataclasses.replace(SIZES["n6"], width_multiple=0.125, classes=3)


def p2_layers() -> tuple[Layer, ...]:
    """The official layers with one more level, of stride 4, as in YOLOv5's yolov5-p2.yaml."""
    *neck, _ = TINY.layers
    return (
        *neck[:18],
        Layer((-1,), 1, "Conv", (128, 1, 1)),
        Layer((-1,), 1, "Upsample"),
        Layer((-1, 2), 1, "Concat"),
        Layer((-1,), 1, "C3", (128, 0)),
        Layer((-1,), 1, "Conv", (128, 3, 2)),
        Layer((-1, 18), 1, "Concat"),
        Layer((-1,), 3, "C3", (256, 0)),
        Layer((-1,), 1, "Conv", (256, 3, 2)),
        Layer((-1, 14), 1, "Concat"),
        Layer((-1,), 3, "C3", (512, 0)),
        Layer((-1,), 1, "Conv", (512, 3, 2)),
        Layer((-1, 10), 1, "Concat"),
        Layer((-1,), 3, "C3", (1024, 0)),
        Layer((21, 24, 27, 30), 1, "Detect"),
    )


P2 = dataclasses.replace(
    TINY, strides=(4, 8, 16, 32), anchors_px=(((4.0, 5.0),) * 3, *TINY.anchors_px), layers=p2_layers()
)


def read(architecture: Architecture = SMALL, **options: Any) -> Model:
    return read_checkpoint(saved(stripped(official_model(architecture, **options))))


def names_of(classes: int) -> list[str]:
    return [f"class {index}" for index in range(classes)]


@pytest.mark.parametrize("half", [True, False], ids=["fp16", "fp32"])
@pytest.mark.parametrize("kind", ["models.yolo.Model", "models.yolo.DetectionModel"])
def test_the_tensors_are_those_that_were_saved(kind: str, half: bool) -> None:
    model = read(kind=kind, half=half)
    expected = random_network(0, SMALL)
    state_dict = (expected.half() if half else expected).float().state_dict()
    assert model.state_dict.keys() == state_dict.keys()
    for key, tensor in model.state_dict.items():
        assert tensor.dtype is (torch.int64 if key.endswith("num_batches_tracked") else torch.float32)
        assert torch.equal(tensor, state_dict[key]), key


@pytest.mark.parametrize(
    "architecture",
    [
        pytest.param(TINY, id="n layout"),
        pytest.param(TINY_N6, id="P6 layout"),
        pytest.param(P2, id="P2 head"),
        pytest.param(dataclasses.replace(SMALL, depth_multiple=0.67), id="deeper"),
        pytest.param(dataclasses.replace(SMALL, width_multiple=0.1), id="odd width"),
        pytest.param(
            dataclasses.replace(SMALL, anchors_px=tuple(level[:1] for level in SMALL.anchors_px)),
            id="one anchor a level",
        ),
        pytest.param(
            dataclasses.replace(SMALL, anchors_px=(((7.5, 9.25),) * 2,) * 2), id="anchors that were evolved"
        ),
    ],
)
def test_the_architecture_is_read_from_the_file(architecture: Architecture) -> None:
    model = read(architecture)
    assert _without_anchors(model.architecture) == _without_anchors(architecture)
    assert np.allclose(model.architecture.anchors_px, architecture.anchors_px, rtol=2e-3)
    network = Network(model.architecture)
    network.load_state_dict(model.state_dict, strict=True)
    side = max(architecture.strides)
    cells = sum((side // stride) ** 2 * len(architecture.anchors_px[0]) for stride in architecture.strides)
    assert network.eval()(torch.zeros(1, 3, side, side)).shape == (1, cells, 8)


def _without_anchors(architecture: Architecture) -> Architecture:
    return dataclasses.replace(architecture, anchors_px=())


@pytest.mark.parametrize("classes", [1, 2, 80, 365])
def test_any_number_of_classes_is_read(classes: int) -> None:
    model = read(dataclasses.replace(SMALL, classes=classes), names=names_of(classes))
    assert model.architecture.classes == classes
    assert model.class_names == tuple(names_of(classes))


@pytest.mark.parametrize(
    "names",
    [
        pytest.param(list(CLASS_NAMES), id="list"),
        pytest.param(dict(enumerate(CLASS_NAMES)), id="dict"),
        pytest.param({2: "cow", 0: "cat", 1: "dog"}, id="dict in another order"),
    ],
)
def test_names_may_be_a_list_or_a_dict(names: object) -> None:
    assert read(names=names).class_names == CLASS_NAMES


def test_names_may_be_of_any_script() -> None:
    assert read(names=["Fußgänger", "自行车", "voiture à cheval"]).class_names[1] == "自行车"


def test_equal_names_of_two_classes_are_kept() -> None:
    assert read(names=["item", "item", "other"]).class_names == ("item", "item", "other")


def test_names_of_any_kind_become_text_at_their_index(tmp_path: Path) -> None:
    family = "👩\u200d👩\u200d👧"
    names = {0: 7, 1: False, 2: family, "3": "a\u00a0b\tc", 5: "\x1b[2J"}
    model = read(dataclasses.replace(SMALL, classes=6), names=names)
    assert model.class_names == ("7", "False", family, "a b c", "class 4", r"\x1b[2J")
    write_safetensors(model, tmp_path / "again.safetensors")
    assert read_safetensors((tmp_path / "again.safetensors").read_bytes()).class_names == model.class_names


def synchronized(model: Any) -> Any:
    """`model` as a training with --sync-bn leaves it."""
    for module in vars(model)["_modules"].values():
        synchronized(module)
        if type(module) is torch.nn.BatchNorm2d:
            module.__class__ = torch.nn.SyncBatchNorm  # type: ignore[assignment]  # with the same attributes
            vars(module).update(process_group=None, ddp_gpu_size=None)
    return model


@pytest.mark.parametrize("kind", ["models.yolo.Model", "models.yolo.DetectionModel"])
def test_a_model_trained_with_synchronized_normalisation_is_the_same(kind: str) -> None:
    synchronous = read_checkpoint(saved(stripped(synchronized(official_model(kind=kind)))))
    expected = read(kind=kind)
    assert synchronous.architecture == expected.architecture
    assert synchronous.state_dict.keys() == expected.state_dict.keys()
    assert all(torch.equal(synchronous.state_dict[key], each) for key, each in expected.state_dict.items())


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        pytest.param({"eps": 1e-5}, "model.0.bn.eps is 1e-05, expected 0.001", id="epsilon"),
        pytest.param({"track_running_stats": False}, "track_running_stats is False", id="statistics"),
    ],
)
def test_synchronized_normalisation_that_computes_something_else_is_refused(
    attributes: dict[str, object], message: str
) -> None:
    model = synchronized(official_model())
    vars(vars(layers_of(model)["0"])["_modules"]["bn"]).update(attributes)
    with pytest.raises(WeightsError, match=message):
        read_checkpoint(saved(stripped(model)))


@pytest.mark.long
@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda: stripped(official_model()), id="stripped"),
        pytest.param(lambda: training_checkpoint(ema=official_model()), id="training"),
        pytest.param(
            lambda: stripped(official_model(kind="models.yolo.Model", before_v6=True)), id="before v6"
        ),
    ],
)
def test_every_protocol_of_pickle_gives_the_same_model(make: Callable[[], Any], protocol: int) -> None:
    found, expected = (read_checkpoint(saved(make(), each)) for each in (protocol, 2))
    assert (found.architecture, found.class_names) == (expected.architecture, expected.class_names)
    assert found.state_dict.keys() == expected.state_dict.keys()
    assert all(torch.equal(found.state_dict[key], each) for key, each in expected.state_dict.items())


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the compiler, when it is imported
def test_a_model_that_torch_compiled_is_refused_with_the_remedy() -> None:
    """What torch itself writes; a short list of its names is among the hostile files."""
    compiled = torch.compile(torch.nn.Conv2d(3, 4, 1))
    with pytest.raises(WeightsError, match=r"after torch\.compile and .* save `model._orig_mod` instead"):
        read_checkpoint(saved({"model": compiled}))


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_a_segmentation_model_is_read_from_every_protocol(protocol: int) -> None:
    model = official_model(SMALL_FAMILIES["segmentation"], kind="models.yolo.SegmentationModel")
    found = read_checkpoint(saved(stripped(model), protocol))
    assert found.architecture.mask_coefficients == 8


def training_checkpoint(*, ema: Any) -> dict[str, Any]:
    """last.pt, before YOLOv5 strips it: optimizer, options, a fitness of numpy."""
    parameter = torch.nn.Parameter(torch.ones(3))
    optimizer = torch.optim.SGD([parameter], lr=0.01, momentum=0.9)
    parameter.grad = torch.ones(3)
    optimizer.step()
    return {
        "epoch": 7,
        "best_fitness": np.array([0.5]),
        "model": official_model(seed=1, half=False),
        "ema": ema,
        "updates": 1234,
        "optimizer": optimizer.state_dict(),
        "opt": {"weights": PosixPath("yolov5n.pt"), "fitness": np.float64(0.5), "freeze": [0]},
        "git": {"remote": None, "branch": None, "commit": None},
        "date": datetime.datetime(2024, 1, 2, 3, 4, 5),
        "wandb_id": None,
    }


@pytest.mark.long
def test_of_a_training_checkpoint_the_averaged_model_is_read() -> None:
    model = read_checkpoint(saved(training_checkpoint(ema=official_model(seed=2, half=False))))
    key = "model.0.conv.weight"
    assert torch.equal(model.state_dict[key], random_network(2, SMALL).state_dict()[key])


def test_the_averaged_model_may_be_a_pair_with_its_updates() -> None:
    """As YOLOv5 wrote it between v4.0 and v5.0."""
    model = read_checkpoint(saved(training_checkpoint(ema=(official_model(seed=2, half=False), 1234))))
    key = "model.0.conv.weight"
    assert torch.equal(model.state_dict[key], random_network(2, SMALL).state_dict()[key])


def test_of_a_training_checkpoint_without_an_averaged_model_the_model_is_read() -> None:
    model = read_checkpoint(saved(training_checkpoint(ema=None)))
    key = "model.0.conv.weight"
    assert torch.equal(model.state_dict[key], random_network(1, SMALL).state_dict()[key])


def test_options_may_be_a_namespace() -> None:
    options = {"opt": foreign("utils.general.Options", epochs=300)}
    assert read_checkpoint(saved(stripped(official_model()) | options)).class_names == CLASS_NAMES


def with_adam(*, amsgrad: bool) -> dict[str, Any]:
    """The largest checkpoint that a training leaves: all twice, and three numbers for each weight."""
    weights = [parameter.data for parameter in random_network(0, SMALL).parameters()]
    optimizer = torch.optim.Adam([torch.nn.Parameter(weight) for weight in weights], amsgrad=amsgrad)
    for parameter in optimizer.param_groups[0]["params"]:
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    ema = official_model(seed=2, half=True)
    return training_checkpoint(ema=ema) | {"optimizer": optimizer.state_dict()}


@pytest.mark.parametrize("amsgrad", [False, True])
def test_a_training_checkpoint_may_hold_what_its_optimizer_needs(
    amsgrad: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint_bytes = len(pickle_of(data := saved(with_adam(amsgrad=amsgrad))))
    monkeypatch.setattr(checkpoint, "MAX_SURPLUS_BYTES", 2 * checkpoint_bytes + 200_000)  # zip's own, too
    key = "model.0.conv.weight"
    assert torch.equal(
        read_checkpoint(data).state_dict[key], random_network(2, SMALL).half().float().state_dict()[key]
    )


def test_a_file_that_is_mostly_something_else_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "MAX_SURPLUS_BYTES", 1 << 20)
    data = saved(stripped(official_model()) | {"more": torch.zeros(1 << 20)})
    with pytest.raises(WeightsError, match="bytes that belong to no layer"):
        read_checkpoint(data)


def test_what_belongs_to_no_layer_is_not_read() -> None:
    """Nor would it be noticed that it is damaged."""
    data = saved(training_checkpoint(ema=official_model(seed=2)) | {"more": torch.full((64,), 7.0)})
    damaged = data.replace(torch.full((64,), 7.0).numpy().tobytes(), bytes(256))
    assert damaged != data
    assert read_checkpoint(damaged).class_names == CLASS_NAMES


def with_shared_normalisation(model: Any) -> Any:
    first, second = (vars(layers_of(model)[index])["_modules"] for index in ("0", "1"))
    second["bn"] = first["bn"]
    return model


@pytest.mark.parametrize(
    ("changed", "shared"),
    [
        pytest.param(in_one_storage, {}, id="views of one storage"),
        pytest.param(with_shared_normalisation, {"model.1.bn.": "model.0.bn."}, id="a tensor twice"),
    ],
)
def test_a_storage_of_several_tensors_is_read_once(
    changed: Callable[[Any], Any], shared: dict[str, str]
) -> None:
    expected = dict(read().state_dict)
    for key, (ours, theirs) in itertools.product(expected, shared.items()):
        if key.startswith(ours):
            expected[key] = expected[key.replace(ours, theirs)]
    data = saved(stripped(changed(official_model())))
    with mock.patch.object(Archive, "record", autospec=True, side_effect=Archive.record) as record:
        found = read_checkpoint(data).state_dict
    records = [name for (_, name, *_), _ in record.call_args_list]
    assert len(records) == len(set(records)) > 0
    assert all(torch.equal(found[key], tensor) for key, tensor in expected.items())


def counted_by_thop(model: Any) -> None:
    for module in modules_of(model):
        for name in ("total_ops", "total_params"):
            vars(module)["_buffers"][name] = torch.zeros(1, dtype=torch.float64)


def test_what_thop_counted_is_not_read() -> None:
    model = official_model()
    counted_by_thop(model)
    assert read_checkpoint(saved(stripped(model))).state_dict.keys() == read().state_dict.keys()


def first_convolution(model: Any) -> torch.nn.Conv2d:
    """The first layer's, in fp32: half of them cannot be sorted on every processor."""
    convolution: torch.nn.Conv2d = vars(layers_of(model)["0"])["_modules"]["conv"]
    return convolution.float()


def prune_twice(convolution: torch.nn.Conv2d) -> None:
    prune.l1_unstructured(convolution, "weight", amount=0.3)
    prune.ln_structured(convolution, "weight", amount=1, n=2, dim=0)


def prune_by_hand(convolution: torch.nn.Conv2d) -> None:
    prune.custom_from_mask(convolution, "weight", convolution.weight > 0)


@pytest.mark.parametrize(
    "prune_weight",
    [
        pytest.param(prune_twice, id="two methods"),
        pytest.param(prune_by_hand, id="a mask"),
        pytest.param(lambda convolution: prune.identity(convolution, "weight"), id="nothing"),
    ],
)
def test_pruned_weights_are_those_after_prune_remove(prune_weight: Callable[[Any], object]) -> None:
    model = official_model()
    convolution = first_convolution(model)
    prune_weight(convolution)
    pruned = read_checkpoint(saved(stripped(model))).state_dict["model.0.conv.weight"]
    prune.remove(convolution, "weight")
    assert torch.equal(pruned, convolution.weight)


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        pytest.param(torch.ones(1), r"conv.weight_mask has the shape \(1,\)", id="another shape"),
        pytest.param(torch.ones(8, 3, 6, 6).int(), "conv.weight_mask holds torch.int32", id="integers"),
        pytest.param(None, "conv.weight is missing", id="none"),
    ],
)
def test_a_mask_that_is_not_one_of_pruning_is_refused(mask: torch.Tensor | None, message: str) -> None:
    model = official_model()
    prune.identity(first_convolution(model), "weight")
    vars(first_convolution(model))["_buffers"]["weight_mask"] = mask
    with pytest.raises(WeightsError, match=message):
        read_checkpoint(saved(stripped(model)))


class OnDevice:
    """A tensor that is pickled as torch pickles one of an Apple GPU, DirectML or a TPU."""

    def __init__(self, numbers: int) -> None:
        self._numbers = np.zeros(numbers, np.float32)

    def __reduce__(self) -> Any:
        arguments = (self._numbers, torch.float32, "mps:0", False)
        return torch._utils._rebuild_device_tensor_from_numpy, arguments


@pytest.mark.parametrize("protocol", [2, 4])
@pytest.mark.parametrize(
    ("saved_with", "message"),
    [
        pytest.param(lambda: OnDevice(1), r"on a device.* that wrote it.*model\.cpu\(\)", id="device"),
        pytest.param(lambda: OnDevice(2 << 20), r"on a device.*model\.cpu\(\)", id="device, 8 MiB"),
        pytest.param(
            lambda: torch.nn.utils.weight_norm(torch.nn.Conv2d(1, 1, 1)), "remove_weight_norm", id="norm"
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:.*weight_norm")
def test_a_model_saved_with_more_than_its_weights_is_refused_with_the_remedy(
    saved_with: Callable[[], object], message: str, protocol: int
) -> None:
    with pytest.raises(WeightsError, match=message):
        read_checkpoint(saved(stripped(official_model()) | {"model": saved_with()}, protocol))


@pytest.mark.parametrize("protocol", [2, 4])
@pytest.mark.parametrize("number", [np.int64, np.int8, np.uint16], ids=["int64", "int8", "uint16"])
def test_scalars_of_numpy_are_numbers_and_texts(number: Callable[[int], Any], protocol: int) -> None:
    model = official_model(names={number(index): np.str_(name) for index, name in enumerate(CLASS_NAMES)})
    head(model).nc, model.yaml["nc"], model.yaml["depth_multiple"] = number(3), number(3), np.float64(0.33)
    found = read_checkpoint(saved(stripped(model), protocol))
    assert found.class_names == CLASS_NAMES
    assert found.architecture.classes == 3


def test_another_byte_order_is_refused() -> None:
    data = saved(stripped(official_model()))
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        crc = archive.getinfo(f"{archive.namelist()[0].partition('/')[0]}/byteorder").CRC
    other = data.replace(b"little", b"big   ").replace(
        crc.to_bytes(4, "little"), zlib.crc32(b"big   ").to_bytes(4, "little")
    )
    with pytest.raises(WeightsError, match="in the byte order"):
        read_checkpoint(other)


def pickle_of(data: bytes) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return archive.read(next(name for name in archive.namelist() if name.endswith("data.pkl")))


def test_several_threads_may_read_at_once() -> None:
    data = saved(stripped(official_model()))
    models: list[Model] = []
    threads = [
        threading.Thread(target=lambda: models.append(read_checkpoint(data)), daemon=True) for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert [model.class_names for model in models] == [CLASS_NAMES] * 4


def test_the_tensors_have_memory_of_their_own() -> None:
    model = read()
    storages = {tensor.untyped_storage().data_ptr() for tensor in model.state_dict.values()}
    assert len(storages) == len(model.state_dict)
    assert all(not tensor.requires_grad and tensor.is_contiguous() for tensor in model.state_dict.values())


@pytest.fixture(scope="module")
def official(reference_dir: Path) -> Model:
    return load_weights(reference_dir / "weights" / "yolov5n.pt").model


def test_the_official_model_has_the_official_architecture(official: Model) -> None:
    assert _without_anchors(official.architecture) == _without_anchors(SIZES["n"])
    assert official.architecture.anchors_px == SIZES["n"].anchors_px
    assert len(official.class_names) == 80
    assert (official.class_names[0], official.class_names[79]) == ("person", "toothbrush")


def test_the_official_model_loads_strictly(official: Model) -> None:
    network = Network(official.architecture)
    network.load_state_dict(official.state_dict, strict=True)
    assert sum(parameter.numel() for parameter in network.parameters()) == 1_872_157


def test_the_official_model_as_safetensors_is_the_same_to_the_bit(official: Model, tmp_path: Path) -> None:
    path = tmp_path / "yolov5n.safetensors"
    write_safetensors(official, path)
    again = read_safetensors(path.read_bytes())
    assert (again.architecture, again.class_names) == (official.architecture, official.class_names)
    assert again.state_dict.keys() == official.state_dict.keys()
    for key, tensor in again.state_dict.items():
        assert tensor.dtype is official.state_dict[key].dtype
        assert torch.equal(tensor, official.state_dict[key]), key
    networks = [Network(model.architecture).eval() for model in (official, again)]
    for network, model in zip(networks, (official, again), strict=True):
        network.load_state_dict(model.state_dict)
    pixels = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    assert torch.equal(networks[0](pixels), networks[1](pixels))
