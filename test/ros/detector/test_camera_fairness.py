"""How cameras share one model over the middleware, counted in inferences, however long one takes."""

from __future__ import annotations

import itertools
import threading
from collections import Counter
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from support.camera_client import CameraClient
from support.preparations import Preparations, prediction
from support.served_node import PATIENCE_S, ServedNode, image

SIZES_HW = {"front": (48, 64), "rear": (64, 48), "left": (48, 128)}
"""Of the images, by camera; no two have the same shape."""
ROUNDS = 2
"""How many images each camera sends during one inference; the first may be sent before it begins."""
INFERENCES = 21


class SharedModel:
    """The cameras of an active node, and which of them each inference was for: `served`.

    An inference lasts until `send` has ended `ROUNDS` times: an image of each camera arrives meanwhile.
    """

    def __init__(self, node: ServedNode, prepare: Preparations) -> None:
        self.served: list[str] = []
        self.node = node
        self._prepare = prepare
        self._changed = threading.Condition()
        self._rounds = 0
        self._is_over = False
        self.clients = {name: CameraClient(node, name) for name in SIZES_HW}
        node.bring_to("active")
        prepare.running.run = self._run
        for client in self.clients.values():
            node.wait_for(lambda: client.images.get_subscription_count() > 0, "the node to subscribe")  # noqa: B023

    def send(self, *names: str) -> None:
        """One image of each of these cameras, which the node has taken when this returns."""
        for name in names:
            self.clients[name].send(image(*SIZES_HW[name]))
        self.node.state()  # is answered after the images that were sent before the request are taken
        with self._changed:
            self._rounds += 1
            self._changed.notify_all()

    def send_until(self, condition: Callable[[], bool], *names: str) -> None:
        """Images of these cameras, again and again."""

        def is_done() -> bool:
            self.send(*names)
            return condition()

        self.node.wait_for(is_done, "inferences")

    def send_for(self, inferences: int, *names: str) -> Counter[str]:
        """Images of these cameras during so many inferences; how many were for each."""
        begin = len(self.served)
        self.send_until(lambda: len(self.served) >= begin + inferences, *names)
        return Counter(self.served[begin:])

    def end(self) -> None:
        """Let inference end, from now on at once."""
        with self._changed:
            self._is_over = True
            self._changed.notify_all()

    def _run(self) -> NDArray[np.float32]:
        (height, width, _), *_ = self._prepare.running.calls[-1]
        self.served.append("rear" if height > width else "left" if width > 2 * height else "front")
        with self._changed:
            end = self._rounds + ROUNDS
            assert self._changed.wait_for(lambda: self._rounds >= end or self._is_over, PATIENCE_S)
        return prediction("cat", 0.9)


@pytest.fixture
def shared(prepare: Preparations) -> Iterator[SharedModel]:
    with ServedNode(prepare, parameters=[f"cameras:=[{', '.join(SIZES_HW)}]"]) as node:
        shared = SharedModel(node, prepare)
        try:
            yield shared
        finally:
            shared.end()
    assert node.escaped == []


def test_cameras_of_equal_rate_have_equal_shares(shared: SharedModel) -> None:
    counts = shared.send_for(INFERENCES, *SIZES_HW)
    assert min(counts[name] for name in SIZES_HW) >= 0.95 * max(counts.values()) - 1, counts


def test_an_image_of_a_slow_camera_waits_for_one_inference_of_a_fast_one(shared: SharedModel) -> None:
    fast, slow = "front", "left"
    overtaken = []
    for _ in range(10):
        shared.send_for(2, fast)
        begin = len(shared.served)
        shared.send(slow)
        shared.send_until(lambda: slow in shared.served[begin:], fast)  # noqa: B023
        overtaken.append(shared.served[begin:].index(slow))
    assert max(overtaken) <= 1, overtaken


@pytest.mark.long
@pytest.mark.parametrize("what", ["stalls", "sends garbage", "changes size", "vanishes"])
def test_a_camera_that_misbehaves_takes_no_turn_from_the_others(shared: SharedModel, what: str) -> None:
    others, last = ("front", "rear"), shared.clients["left"]
    shared.send_until(lambda: last.name in shared.served, *SIZES_HW)
    heights = itertools.cycle(range(16, 48))
    misbehave: dict[str, Callable[[], object]] = {
        "stalls": lambda: None,
        "sends garbage": lambda: last.send(image(48, 128, "nonsense")),
        "changes size": lambda: last.send(image(next(heights), 128)),
        "vanishes": lambda: None,
    }
    if what == "vanishes":
        shared.node.client.destroy_publisher(last.images)
    begin = len(shared.served)

    def is_done() -> bool:
        misbehave[what]()
        return len(shared.served) >= begin + INFERENCES

    shared.send_until(is_done, *others)
    counts = Counter(shared.served[begin:])
    share = INFERENCES / (len(SIZES_HW) if what == "changes size" else len(others))
    assert min(counts[name] for name in others) >= 0.95 * share - 1, counts
