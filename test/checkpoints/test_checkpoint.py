"""Checkpoints that YOLOv5 writes become the models that they hold."""

from __future__ import annotations

import dataclasses
import datetime
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path, PosixPath
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from support.checkpoint_builder import (
    SMALL,
    assert_same,
    foreign,
    head,
    in_one_storage,
    layers_of,
    modules_of,
    official_model,
    pickled_method,
    saved,
    stripped,
)
from support.hostile_archives import ARCHIVES, pickle_of
from support.random_model import CLASS_NAMES, TINY, random_network
from support.small_families import SMALL_FAMILIES
from support.wrong_models import MODELS
from torch.nn.utils import prune

from yolov5_lifecycle.checkpoints import pt_file as checkpoint
from yolov5_lifecycle.checkpoints.archive import Archive
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.checkpoints.pt_file import read_checkpoint
from yolov5_lifecycle.checkpoints.safetensors_file import read_safetensors, write_safetensors
from yolov5_lifecycle.models.architecture import SIZES, Architecture
from yolov5_lifecycle.models.model import Model, WeightsError
from yolov5_lifecycle.models.network import Network

TINY_N6 = dataclasses.replace(SIZES["n6"], width_multiple=0.125, classes=3)


FIRST = "model.0.conv.weight"
SEGMENTATION = SMALL_FAMILIES["segmentation"]
WRONG = {**ARCHIVES, **MODELS}


def read(architecture: Architecture = SMALL, **options: Any) -> Model:
    return read_checkpoint(saved(stripped(official_model(architecture, **options))))


@pytest.mark.parametrize(
    ("kind", "half"), [("models.yolo.Model", True), ("models.yolo.DetectionModel", False)]
)
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


def test_names_of_any_kind_become_text_at_their_index(tmp_path: Path) -> None:
    family = "👩\u200d👩\u200d👧"
    names = {0: 7, 1: False, 2: family, "3": "a\u00a0b\tc", 5: "\x1b[2J"}
    model = read(dataclasses.replace(SMALL, classes=6), names=names)
    assert model.class_names == ("7", "False", family, "a b c", "class 4", r"\x1b[2J")
    write_safetensors(model, tmp_path / "again.safetensors")
    assert read_safetensors((tmp_path / "again.safetensors").read_bytes()).class_names == model.class_names


def synchronize(model: Any) -> None:
    """As a training with --sync-bn leaves it."""
    for module in modules_of(model):
        if type(module) is torch.nn.BatchNorm2d:
            module.__class__ = torch.nn.SyncBatchNorm  # type: ignore[assignment]  # with the same attributes
            vars(module).update(process_group=None, ddp_gpu_size=None)


def count_by_thop(model: Any) -> None:
    for module in modules_of(model):
        for name in ("total_ops", "total_params"):
            vars(module)["_buffers"][name] = torch.zeros(1, dtype=torch.float64)


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda model: setattr(layers_of(model)["0"], "training", True), id="training mode"),
        pytest.param(lambda model: vars(layers_of(model)["6"]).update(f=[-1, -4]), id="wiring counted back"),
        pytest.param(lambda model: vars(head(model)).update(inplace=False), id="head not in place"),
        pytest.param(lambda model: model.yaml["backbone"][1][3].append("None"), id="no padding of its own"),
        pytest.param(synchronize, id="synchronized normalisation"),
        pytest.param(count_by_thop, id="counted by thop"),
        pytest.param(
            lambda model: vars(head(model)).update(
                detect=pickled_method(type(foreign("yolov5.models.yolo.Detect")), "forward")
            ),
            id="a method of the package yolov5",
        ),
    ],
)
def test_what_leaves_the_result_alone_is_accepted(change: Callable[[Any], object]) -> None:
    model = official_model()
    change(model)
    assert_same(read_checkpoint(saved(stripped(model))), read())


def test_synchronized_normalisation_that_computes_something_else_is_refused() -> None:
    model = official_model()
    synchronize(model)
    vars(layers_of(model)["0"])["_modules"]["bn"].track_running_stats = False
    with pytest.raises(WeightsError, match="track_running_stats is False"):
        read_checkpoint(saved(stripped(model)))


@pytest.mark.parametrize(("make", "message"), WRONG.values(), ids=WRONG)
def test_a_file_that_cannot_be_used_is_refused(make: Callable[[], bytes], message: str) -> None:
    with pytest.raises(WeightsError) as refused:
        read_checkpoint(make())
    assert message in str(refused.value)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the compiler, when it is imported
def test_a_model_that_torch_compiled_is_refused_with_the_remedy() -> None:
    """What torch itself writes; a short list of its names is among the hostile files."""
    compiled = torch.compile(torch.nn.Conv2d(3, 4, 1))
    with pytest.raises(WeightsError, match=r"after torch\.compile and .* save `model._orig_mod` instead"):
        read_checkpoint(saved({"model": compiled}))


def optimizer_state(weights: Sequence[torch.Tensor], *names: str) -> dict[str, Any]:
    """The state dict of an optimizer with numbers of these names for each weight.

    Written by hand, because an optimizer of torch loads the compiler, which takes seconds and 55 MB.
    """
    state = {index: {name: weight.clone() for name in names} for index, weight in enumerate(weights)}
    return {"state": state, "param_groups": [{"lr": 0.01, "params": list(range(len(weights)))}]}


def training_checkpoint(*, ema: Any) -> dict[str, Any]:
    """last.pt, before YOLOv5 strips it: optimizer, options, a fitness of numpy."""
    return {
        "epoch": 7,
        "best_fitness": np.array([0.5]),
        "model": official_model(seed=1, half=False),
        "ema": ema,
        "updates": 1234,
        "optimizer": optimizer_state([torch.ones(3)], "momentum_buffer"),
        "opt": {"weights": PosixPath("yolov5n.pt"), "fitness": np.float64(0.5), "freeze": [0]},
        "git": {"remote": None, "branch": None, "commit": None},
        "date": datetime.datetime(2024, 1, 2, 3, 4, 5),
        "hyp": foreign("utils.general.Options", epochs=300),
        "wandb_id": None,
        "tags": {"night", 7},
    }


@pytest.mark.parametrize(
    ("make_ema", "seed", "protocol"),
    [
        pytest.param(lambda: official_model(seed=2, half=False), 2, 2, id="averaged"),
        pytest.param(lambda: official_model(seed=2, half=False), 2, 3, id="averaged, protocol 3"),
        pytest.param(lambda: official_model(seed=2, half=False), 2, 5, id="averaged, protocol 5"),
        pytest.param(lambda: (official_model(seed=2, half=False), 1234), 2, 2, id="v4.0: with its updates"),
        pytest.param(lambda: None, 1, 4, id="none, protocol 4"),
    ],
)
def test_of_a_training_checkpoint_the_averaged_model_is_read(
    make_ema: Callable[[], Any], seed: int, protocol: int
) -> None:
    model = read_checkpoint(saved(training_checkpoint(ema=make_ema()), protocol))
    assert torch.equal(model.state_dict[FIRST], random_network(seed, SMALL).state_dict()[FIRST])


def with_adam() -> dict[str, Any]:
    """The largest checkpoint that a training leaves: all twice, and three numbers for each weight."""
    weights = [parameter.data for parameter in random_network(0, SMALL).parameters()]
    adam = optimizer_state(weights, "exp_avg", "exp_avg_sq", "max_exp_avg_sq")
    return training_checkpoint(ema=official_model(seed=2, half=True)) | {"optimizer": adam}


def test_a_training_checkpoint_may_hold_what_its_optimizer_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint_bytes = len(pickle_of(data := saved(with_adam())))
    monkeypatch.setattr(checkpoint, "MAX_SURPLUS_BYTES", 2 * checkpoint_bytes + 200_000)  # zip's own, too
    expected = random_network(2, SMALL).half().float().state_dict()[FIRST]
    assert torch.equal(read_checkpoint(data).state_dict[FIRST], expected)


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
    ],
)
def test_pruned_weights_are_those_after_prune_remove(prune_weight: Callable[[Any], object]) -> None:
    model = official_model()
    convolution = first_convolution(model)
    prune_weight(convolution)
    pruned = read_checkpoint(saved(stripped(model))).state_dict[FIRST]
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

    def __reduce__(self) -> Any:
        arguments = (np.zeros(1, np.float32), torch.float32, "mps:0", False)
        return torch._utils._rebuild_device_tensor_from_numpy, arguments


@pytest.mark.parametrize("protocol", [2, 4])
@pytest.mark.parametrize(
    ("saved_with", "message"),
    [
        pytest.param(OnDevice, r"on a device.* that wrote it.*model\.cpu\(\)", id="device"),
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
def test_scalars_of_numpy_are_numbers_and_texts(protocol: int) -> None:
    model = official_model(names={np.int64(index): np.str_(name) for index, name in enumerate(CLASS_NAMES)})
    head(model).nc, model.yaml["nc"], model.yaml["depth_multiple"] = (
        np.int8(3),
        np.uint16(3),
        np.float64(0.33),
    )
    found = read_checkpoint(saved(stripped(model), protocol))
    assert found.class_names == CLASS_NAMES
    assert found.architecture.classes == 3


def test_the_official_model_is_the_same_to_the_bit_as_safetensors(
    reference_dir: Path, tmp_path: Path
) -> None:
    official = load_weights(reference_dir / "weights" / "yolov5n.pt").model
    assert _without_anchors(official.architecture) == _without_anchors(SIZES["n"])
    assert official.architecture.anchors_px == SIZES["n"].anchors_px
    path = tmp_path / "yolov5n.safetensors"
    write_safetensors(official, path)
    again = read_safetensors(path.read_bytes())
    assert_same(again, official)
