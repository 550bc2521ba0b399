"""Asks a detector for its state all the time, and at SIGTERM tells how long the slowest answer took.

The only argument is the name of the detector. Runs as a separate process, because large images that the
process received, too, would delay the answers.
"""

from __future__ import annotations

import sys
import threading
import time

import rclpy
from lifecycle_msgs.srv import GetState
from rclpy.signals import SignalHandlerOptions

from yolov5_lifecycle.process.termination import on_termination

LONGEST = "longest answer: "
_ANSWER_S = 60.0
_PAUSE_S = 0.005


def main() -> int:
    is_over = threading.Event()
    on_termination(lambda _: is_over.set())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("asker")
    client = node.create_client(GetState, f"{sys.argv[1]}/get_state")
    assert client.wait_for_service(_ANSWER_S)
    print("asking", flush=True)
    longest_s = 0.0
    while not is_over.wait(_PAUSE_S):
        begun_s = time.monotonic()
        rclpy.spin_until_future_complete(node, client.call_async(GetState.Request()), timeout_sec=_ANSWER_S)
        longest_s = max(longest_s, time.monotonic() - begun_s)
    print(f"{LONGEST}{longest_s:.3f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
