"""What the node knows of itself, and what it makes of it."""

from __future__ import annotations

from dataclasses import dataclass

from rclpy.qos import ReliabilityPolicy

from yolov5_lifecycle.boxes import WORTH_TELLING
from yolov5_lifecycle.empty_frames import EmptyRun
from yolov5_lifecycle.frame_balance import FrameBalance, Outcome
from yolov5_lifecycle.preparation import PreparedModel
from yolov5_lifecycle.rate import LatencySummary
from yolov5_lifecycle.ros.image_input import InputStatus
from yolov5_lifecycle.settings import Settings

MANY_LOST = 4
"""One image lost for so many received is worth a word."""
SILENCE_S = 2.0
"""An active camera that sends nothing for longer than this is worth a word."""
EMPTY_S = 10.0
"""Frames in which nothing is found for longer than this are worth a word."""
SLOW_S = 2.0
"""Inference that takes longer than this for one image is worth a word."""

_REMEDIES = {
    "unconfigured": ": configure and activate the node to detect",
    "inactive": ": activate the node to detect",
}


@dataclass(frozen=True)
class Status:
    """One look at the node. `settings` exist from configure on; the rest below only while active.

    `busy_s`: how long inference has been at the image in work, in seconds.
    """

    state: str
    problem: str
    balance: FrameBalance
    settings: Settings | None
    model: PreparedModel | None
    input: InputStatus | None
    latency: LatencySummary | None
    empty: EmptyRun | None
    busy_s: float
    recently_rejected: str

    @property
    def hint(self) -> str:
        """What is wrong when nothing comes out of an active node."""
        if self.state != "active" or self.input is None:
            return ""
        if self.busy_s > SLOW_S:
            return (
                f"inference has been at one image for more than {SLOW_S:g} s: the model is too slow for this "
                "machine, or it hangs; deactivate ends that, then activate again"
            )
        if self.input.publishers == 0:
            return f"nobody publishes images on {self.input.topic}: start the camera or remap the topic"
        if self.input.reliability is ReliabilityPolicy.RELIABLE and self.input.best_effort_publishers:
            return (
                f"a best-effort publisher on {self.input.topic} does not match this reliable subscription: "
                "set image_reliability to auto or best_effort"
            )
        if self.input.silent_s > SILENCE_S:
            silent_s = f"{self.input.silent_s:.0f} s"
            return f"no image on {self.input.topic} for {silent_s}, though somebody publishes there"
        if self.input.lost_lately > self.input.received_lately / MANY_LOST:
            lost, received = self.input.lost_lately, self.input.received_lately
            return (
                f"{lost} of {lost + received} images were lost on the way in the last second: "
                "give the camera's process the profile config/shm.xml, or send compressed images if it is on "
                "another machine"
            )
        if self.recently_rejected:
            return f"images are rejected: {self.recently_rejected}"
        return ""

    @property
    def remark(self) -> str:
        """Why nothing comes out of the node though nothing is wrong with it."""
        if self.state != "active":
            return self.state + _REMEDIES.get(self.state, "")
        if self.input is None:
            return "idle (lazy): nobody listens to ~/detections or ~/image, so no images are taken"
        if self.empty is not None and self.empty.duration_s > EMPTY_S:
            missed = self.empty.best_missed
            best = f"the best {missed:.2g}" if missed else f"nothing even above {WORTH_TELLING:g}"
            return (
                f"nothing scored above confidence_threshold {self.empty.threshold:g} in the last "
                f"{self.empty.frames} frames, {best}: if there was something, lower it, or empty classes"
            )
        return ""

    @property
    def message(self) -> str:
        """One line for a person."""
        return self.problem or self.hint or self.remark or "detecting"

    def values(self) -> dict[str, str]:
        """Everything as texts, for diagnostics."""
        values = {"state": self.state, "last problem": self.problem}
        values |= {f"frames {outcome.value}": str(self.balance[outcome]) for outcome in Outcome}
        values |= {"frames received": str(self.balance.received), "frames pending": str(self.balance.pending)}
        if self.settings is not None:
            values["configuration"] = self.settings.digest()
        if self.model is not None:
            values |= self.model.facts
        if self.input is not None:
            values |= {
                "image topic": self.input.topic,
                "image reliability": self.input.reliability.name.lower(),
            }
            values |= {"image publishers": str(self.input.publishers), "frames lost": str(self.input.lost)}
        if self.latency is not None:
            values["rate Hz"] = f"{self.latency.rate_hz:.1f}"
            values["latency median ms"] = f"{self.latency.median_ms:.1f}"
            values["latency p95 ms"] = f"{self.latency.p95_ms:.1f}"
        if self.empty is not None:
            values["empty frames in a row"] = str(self.empty.frames)
            values["best score in them"] = f"{self.empty.best_missed:.2g}"
        return values
