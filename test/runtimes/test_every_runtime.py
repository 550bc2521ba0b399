"""What every runtime does alike: colours, memory of its own, denormal numbers, closing."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import torch
from support.random_model import random_frame, random_model
from support.runtime_names import EVERY_RUNTIME
from support.scripted_camera import PATIENCE_S

from yolov5_lifecycle.images.image import Order
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.runtimes.compiler import Compiler, Loaded, Threads
from yolov5_lifecycle.runtimes.networks_by_shape import Shape, are_zero
from yolov5_lifecycle.runtimes.registry import load_runtime
from yolov5_lifecycle.runtimes.runtime import InferenceError, Runtime
from yolov5_lifecycle.runtimes.sparse_head import DetectionHead


@pytest.fixture(params=EVERY_RUNTIME)
def runtime_name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def runtime(runtime_name: str) -> Runtime:
    return loaded(random_model(1), runtime_name)


def loaded(model: Model, runtime_name: str) -> Runtime:
    return load_runtime(model, runtime_name, device="cpu", precision="fp32")


def test_the_order_of_colours_makes_no_difference(runtime: Runtime) -> None:
    frame = random_frame()
    np.testing.assert_array_equal(runtime(frame, "rgb").rows, runtime(frame[..., ::-1].copy(), "bgr").rows)
    assert not np.array_equal(runtime(frame, "rgb").rows, runtime(frame, "bgr").rows)


def test_frame_and_earlier_predictions_stay_as_they_are(runtime: Runtime) -> None:
    frame = random_frame()
    orders: list[Order] = ["rgb", "bgr"]
    for order in orders:
        first = runtime(frame, order).rows
        before = first.copy()
        runtime(255 - frame, order)
        np.testing.assert_array_equal(first, before)
    np.testing.assert_array_equal(frame, random_frame())


def test_a_closed_runtime_says_so_and_may_be_closed_again(runtime: Runtime) -> None:
    runtime(random_frame(), "rgb")
    runtime.close()
    runtime.close()
    with pytest.raises(InferenceError, match="closed"):
        runtime(random_frame(), "rgb")


@pytest.mark.long
def test_lanes_give_the_same_predictions_at_the_same_time(runtime: Runtime) -> None:
    frames = [np.roll(random_frame(), shift, axis=0) for shift in range(4)]
    first, *others = runtime.lanes(3, threads=1)
    expected = [first(frame, "rgb").rows for frame in frames]
    np.testing.assert_allclose(expected[0], runtime(frames[0], "rgb").rows, rtol=1e-3, atol=1e-3)
    together = threading.Barrier(3)

    def run(each: Runtime) -> bool:
        together.wait(PATIENCE_S)
        return all(
            np.array_equal(each(frames[index % 4], "rgb").rows, expected[index % 4]) for index in range(100)
        )

    with ThreadPoolExecutor(3) as threads:
        assert list(threads.map(run, (first, *others))) == [True, True, True]


@pytest.mark.long
def test_lanes_are_closed_one_by_one_and_outlive_the_runtime_that_they_come_from(runtime: Runtime) -> None:
    left, right = runtime.lanes(2, threads=1)
    expected = left(random_frame(), "rgb").rows
    left.close()
    runtime.close()
    np.testing.assert_array_equal(right(random_frame(), "rgb").rows, expected)
    with pytest.raises(InferenceError, match="closed"):
        left(random_frame(), "rgb")
    with pytest.raises(InferenceError, match="closed"):
        runtime.lanes(2, threads=1)


@pytest.mark.parametrize("name", ["onnxruntime", "openvino"])
def test_lanes_share_one_compiled_network(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: list[Threads] = []
    original = Compiler.network

    def counted(compiler: Compiler, shape: Shape, threads: Threads) -> Loaded:
        compiled.append(threads)
        return original(compiler, shape, threads)

    monkeypatch.setattr(Compiler, "network", counted)
    for lane in loaded(random_model(1), name).lanes(3, threads=2):
        lane(random_frame(), "rgb")
    assert compiled == [Threads(each=2, at_once=3)]


def test_torch_uses_the_threads_of_a_lane_only_in_the_lane(monkeypatch: pytest.MonkeyPatch) -> None:
    before, seen = torch.get_num_threads(), list[int]()
    original = Network.features

    def watched(*arguments: Any) -> Any:
        seen.append(torch.get_num_threads())
        return original(*arguments)

    monkeypatch.setattr(Network, "features", watched)
    runtime = loaded(random_model(1), "torch")
    (lane,) = runtime.lanes(1, threads=before + 1)
    lane(random_frame(), "rgb")
    runtime(random_frame(), "rgb")
    assert seen == [before + 1, before]
    assert torch.get_num_threads() == before


def test_a_thread_that_begins_while_a_lane_runs_has_all_threads_for_the_whole_network(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """torch hands the number of threads that was set last on to every new thread."""
    before, seen = torch.get_num_threads(), list[int]()
    original = Network.features
    with ThreadPoolExecutor(1) as late:

        def watched(*arguments: Any) -> Any:
            monkeypatch.setattr(Network, "features", noted)
            late.submit(runtime, random_frame(), "rgb").result()
            return original(*arguments)

        def noted(*arguments: Any) -> Any:
            seen.append(torch.get_num_threads())
            return original(*arguments)

        monkeypatch.setattr(Network, "features", watched)
        runtime = loaded(random_model(1), "torch")
        (lane,) = runtime.lanes(1, threads=before + 1)
        lane(random_frame(), "rgb")
    assert seen == [before]
    with ThreadPoolExecutor(1) as later:
        assert later.submit(torch.get_num_threads).result() == before


@pytest.mark.long
def test_denormal_numbers_are_zero_while_a_network_runs_and_not_after(
    runtime_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A network that computes with them takes ten times as long, and weights can be made for that."""
    seen: list[bool] = []
    owner, attribute = (Network, "features") if runtime_name == "torch" else (DetectionHead, "__call__")
    original = getattr(owner, attribute)

    def watched(*arguments: Any) -> Any:
        seen.append(are_zero())
        return original(*arguments)

    monkeypatch.setattr(owner, attribute, watched)
    runtime = loaded(random_model(0), runtime_name)
    frame = np.zeros((64, 64, 3), np.uint8)
    runtime(frame, "rgb")
    assert seen == [True]
    assert not are_zero()
