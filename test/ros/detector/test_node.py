"""The node's contract towards its neighbours, with a runtime that does what the test says."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image
from support.served_node import Preparations, ServedNode, class_ids_of, image, prediction

from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW
from yolov5_lifecycle.ros.detector.session import REST_TIMEOUT_S
from yolov5_lifecycle.ros.messages import picture
from yolov5_lifecycle.runtimes.runtime import DeviceLostError
from yolov5_lifecycle.settings.settings import SETTINGS

STATES = ("unconfigured", "inactive", "active")
LEGAL_NUMBERS = {"unconfigured": (1, 5), "inactive": (3, 2, 6), "active": (4, 7), "finalized": ()}
"""What lifecycle_msgs calls the transitions out of each state."""


@pytest.fixture
def prepare(ros_domain: int) -> Preparations:
    return Preparations()


@pytest.fixture
def served(prepare: Preparations) -> Iterator[ServedNode]:
    with ServedNode(prepare) as served:
        yield served
    assert served.escaped == []


def begin_loading(served: ServedNode, prepare: Preparations) -> Any:
    """Ask an inactive node to activate, which waits for `prepare.gate`; the future of the answer."""
    served.bring_to("inactive")
    prepare.gate.clear()
    answer = served.begin_transition("activate")
    assert prepare.begun.acquire(timeout=10)
    return answer


# Lifecycle


def test_a_full_cycle_detects_only_while_active(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("inactive")
    assert prepare.runtimes == []
    assert served.transition("activate")
    assert class_ids_of(served.detect()) == ["cat"]
    assert served.transition("deactivate")
    assert prepare.running.is_closed
    assert served.transition("activate")
    assert class_ids_of(served.detect()) == ["cat"]
    assert served.transition("deactivate")
    assert served.transition("cleanup")
    assert served.transition("shutdown")
    assert served.state() == "finalized"
    assert [runtime.is_closed for runtime in prepare.runtimes] == [True, True]


@pytest.mark.parametrize("state", STATES)
def test_an_illegal_transition_is_refused_and_nothing_changes(served: ServedNode, state: str) -> None:
    legal = {
        "unconfigured": {"configure", "shutdown"},
        "inactive": {"activate", "cleanup", "shutdown"},
        "active": {"deactivate", "shutdown"},
    }
    served.bring_to(state)
    for label in ("configure", "activate", "deactivate", "cleanup", "destroy", "nonsense", ""):
        if label not in legal[state]:
            assert not served.transition(label, transition_id=99)
    assert served.state() == state


def test_refused_transitions_do_not_flood_the_log(served: ServedNode) -> None:
    begun_s = time.monotonic()
    for _ in range(100):
        assert not served.transition("cleanup")
    most = time.monotonic() - begun_s + 1
    assert served.transition("configure")
    served.wait_for_log("configured with")
    assert 1 <= sum("'cleanup' refused in state unconfigured" in said for said in served.log) <= most


@pytest.mark.parametrize("state", LEGAL_NUMBERS)
def test_every_transition_number_is_answered(served: ServedNode, state: str) -> None:
    """A process stays finalized for seconds and then ends; a node alone goes on answering."""
    served.bring_to(state)
    for transition_id in sorted(set(range(256)) - set(LEGAL_NUMBERS[state])):
        assert not served.transition("", transition_id)
    assert served.state() == state


@pytest.mark.parametrize(
    ("state", "transition_id"),
    [(state, transition_id) for state, legal in LEGAL_NUMBERS.items() for transition_id in legal],
)
def test_a_transition_may_be_asked_for_by_its_number(
    served: ServedNode, state: str, transition_id: int
) -> None:
    served.bring_to(state)
    assert served.transition("", transition_id)
    assert served.state() != state


def test_shutdown_from_active_frees_the_model(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("active")
    assert served.transition("shutdown")
    assert prepare.running.is_closed


def test_activate_that_cannot_load_says_why_and_stays_inactive(
    served: ServedNode, prepare: Preparations
) -> None:
    prepare.refusal = "/no/such.pt: there is no such file"
    served.bring_to("inactive")
    assert not served.transition("activate")
    assert served.state() == "inactive"
    assert "/no/such.pt" in served.status().message
    prepare.refusal = ""
    assert served.transition("activate")
    assert "/no/such.pt" not in served.status().message


def test_an_unexpected_exception_in_activate_leads_back_to_unconfigured(ros_domain: int) -> None:
    def broken(settings: object, source_hw: object) -> None:
        raise KeyError("surprise")

    with ServedNode(broken) as served:  # type: ignore[arg-type]
        served.bring_to("inactive")
        assert not served.transition("activate")
        assert served.state() == "unconfigured"
        assert "surprise" in served.status().message
        served.wait_for_log("Traceback")
        assert served.transition("configure")


@pytest.mark.parametrize("label", ["deactivate", "shutdown"])
def test_an_unexpected_exception_while_releasing_releases_the_rest(
    served: ServedNode, prepare: Preparations, label: str
) -> None:
    served.bring_to("active")

    def fail_to_close() -> None:
        raise KeyError("surprise")

    prepare.running.on_close = fail_to_close
    assert not served.transition(label)
    assert served.state() == "unconfigured"
    served.wait_for_log(f"unexpected KeyError in on_{label}: 'surprise'")
    served.wait_for(lambda: served.images.get_subscription_count() == 0, "the node to unsubscribe")
    served.wait_for(lambda: served.client.count_publishers("/yolov5/detections") == 0, "the publishers to go")


def test_services_answer_while_the_model_loads(served: ServedNode, prepare: Preparations) -> None:
    activation = begin_loading(served, prepare)
    assert served.state() == "inactive"
    assert served.get("confidence_threshold") == 0.25
    assert not activation.done()
    prepare.gate.set()
    served.wait_for(activation.done, "activate")
    assert activation.result().success
    assert served.state() == "active"


def test_a_second_activate_while_loading_is_refused(served: ServedNode, prepare: Preparations) -> None:
    first = begin_loading(served, prepare)
    assert not served.transition("activate")
    prepare.gate.set()
    served.wait_for(first.done, "the first activate")
    assert first.result().success
    assert len(prepare.runtimes) == 1


@pytest.mark.parametrize(("label", "state"), [("cleanup", "unconfigured"), ("shutdown", "finalized")])
def test_another_transition_wins_over_a_loading_activate(
    served: ServedNode, prepare: Preparations, label: str, state: str
) -> None:
    activation = begin_loading(served, prepare)
    assert served.transition(label)
    prepare.gate.set()
    served.wait_for(activation.done, "activate")
    assert not activation.result().success
    assert served.state() == state
    assert all(runtime.is_closed for runtime in prepare.runtimes)


def test_cleanup_wins_over_an_activate_whose_model_cannot_be_loaded(
    served: ServedNode, prepare: Preparations
) -> None:
    prepare.refusal = "/no/such.pt: there is no such file"
    activation = begin_loading(served, prepare)
    assert served.transition("cleanup")
    prepare.gate.set()
    served.wait_for(activation.done, "activate")
    assert not activation.result().success
    served.wait_for_log("activate canceled: another transition came")
    assert "/no/such.pt" not in served.status().message


def test_an_activate_of_an_earlier_configuration_is_given_up(
    served: ServedNode, prepare: Preparations
) -> None:
    earlier = begin_loading(served, prepare)
    assert served.transition("cleanup")
    assert served.transition("configure")
    later = served.begin_transition("activate")
    prepare.gate.set()
    served.wait_for(lambda: earlier.done() and later.done(), "both answers")
    assert (earlier.result().success, later.result().success) == (False, True)
    assert [runtime.is_closed for runtime in prepare.runtimes] == [True, False]


def test_a_path_mended_while_the_wrong_one_is_looked_for_is_loaded(
    served: ServedNode, prepare: Preparations
) -> None:
    prepare.refusal = "/no/such.pt: there is no such file"
    activation = begin_loading(served, prepare)
    prepare.on_refusal = lambda: setattr(prepare, "refusal", "")
    assert served.set(weights="/such.pt") == (True, "")
    prepare.gate.set()
    served.wait_for(activation.done, "activate")
    assert activation.result().success


def test_settings_changed_while_loading_are_the_ones_that_run(
    served: ServedNode, prepare: Preparations
) -> None:
    activation = begin_loading(served, prepare)
    assert served.set(image_size=320) == (True, "")
    prepare.gate.set()
    served.wait_for(activation.done, "activate")
    assert [runtime.is_closed for runtime in prepare.runtimes] == [True, False]
    assert class_ids_of(served.detect()) == ["cat"]


# Parameters


def test_live_settings_are_obeyed_from_the_next_frame(served: ServedNode) -> None:
    served.bring_to("active")
    assert class_ids_of(served.detect()) == ["cat"]
    assert served.set(confidence_threshold=0.95) == (True, "")
    assert class_ids_of(served.detect()) == []
    assert served.set(confidence_threshold=0.5, classes=["dog"]) == (True, "")
    assert class_ids_of(served.detect()) == []
    assert served.set(classes=["0"]) == (True, "")
    assert class_ids_of(served.detect()) == ["cat"]


def test_an_unknown_class_is_refused_with_a_suggestion(served: ServedNode) -> None:
    served.bring_to("active")
    done, reason = served.set(classes=["catt"])
    assert not done
    assert "'catt' is not a class" in reason
    assert "Did you mean 'cat'?" in reason
    assert served.get("classes") == []


@pytest.mark.parametrize(
    ("entry", "problem"),
    [
        pytest.param("dgo", "Did you mean 'dog'?", id="typo"),
        pytest.param("9" * 5000, "is out of range: the model has 2 classes", id="index-of-5000-digits"),
    ],
)
def test_activate_refuses_a_class_that_the_model_does_not_have(
    served: ServedNode, prepare: Preparations, entry: str, problem: str
) -> None:
    assert served.set(classes=[entry]) == (True, "")
    served.bring_to("inactive")
    assert not served.transition("activate")
    assert problem in served.status().message
    assert served.state() == "inactive"
    assert prepare.running.is_closed


def test_a_reload_swaps_the_model_and_frees_the_old_one(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("active")
    served.detect()
    assert served.set(image_size=320) == (True, "")
    old, new = prepare.runtimes
    assert old.is_closed
    assert not new.is_closed
    new.run = lambda: prediction("dog", 0.8)
    assert class_ids_of(served.detect()) == ["dog"]


def test_frames_are_detected_while_the_next_model_loads(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("active")
    prepare.gate.clear()
    change = served.begin_set(image_size=320)
    prepare.begun.acquire(timeout=10)
    assert prepare.begun.acquire(timeout=10)
    assert class_ids_of(served.detect()) == ["cat"]
    assert served.state() == "active"
    assert served.get("image_size") == 640
    assert not change.done()
    prepare.gate.set()
    served.wait_for(change.done, "the reload")
    assert change.result().result.successful
    assert served.get("image_size") == 320


def test_a_refused_reload_leaves_model_and_value_alone(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("active")
    prepare.refusal = "/broken.pt: this is no checkpoint"
    done, reason = served.set(weights="/broken.pt")
    assert not done
    assert "/broken.pt: this is no checkpoint" in reason
    assert served.get("weights") == ""
    assert class_ids_of(served.detect()) == ["cat"]
    assert not prepare.running.is_closed


def test_a_model_is_warmed_up_for_pictures_like_the_last_one(
    served: ServedNode, prepare: Preparations
) -> None:
    served.bring_to("active")
    served.detect()
    assert served.set(image_size=320)[0]
    assert served.transition("deactivate")
    assert served.transition("activate")
    picture_hw = image().height, image().width
    assert prepare.sources_hw == [USUAL_SOURCE_HW, picture_hw, picture_hw]


def test_a_reload_is_told_in_the_log(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("active")
    assert served.set(image_size=320)[0]
    served.wait_for_log("the model was replaced: weights /scripted.pt")
    prepare.refusal = "/no/such.pt: there is no such file"
    assert not served.set(image_size=416)[0]
    served.wait_for_log("the running model stays, its replacement was refused: /no/such.pt")


def test_a_reload_that_another_change_contradicts_is_refused_and_freed(
    served: ServedNode, prepare: Preparations
) -> None:
    served.bring_to("active")
    prepare.gate.clear()
    reload = served.begin_set(model_size="n6")  # needs multiples of 64
    assert prepare.begun.acquire(timeout=10)
    other = served.begin_set(image_size=672)
    prepare.gate.set()
    served.wait_for(lambda: reload.done() and other.done(), "both answers")
    answers = [reload.result().result, other.result().result]
    assert sorted(answer.successful for answer in answers) == [False, True]
    assert sum(not runtime.is_closed for runtime in prepare.runtimes) == 1
    assert served.escaped == []


def test_an_unexpected_exception_in_a_reload_is_answered_and_told(
    served: ServedNode, prepare: Preparations
) -> None:
    served.bring_to("active")
    prepare.refusal_type, prepare.refusal = KeyError, "surprise"
    assert served.set(image_size=320) == (False, "KeyError: 'surprise'")
    served.wait_for_log("unexpected KeyError in yolov5/set_parameters_atomically:\n  Traceback")
    assert class_ids_of(served.detect()) == ["cat"]


@pytest.mark.parametrize("state", ["inactive", "active"])
def test_a_device_that_is_lost_while_a_model_loads_ends_the_node(
    served: ServedNode, prepare: Preparations, state: str
) -> None:
    served.bring_to(state)
    prepare.refusal_type = DeviceLostError
    prepare.refusal = "torch failed on cuda:0"
    answered = served.transition("activate") if state == "inactive" else served.set(image_size=320)[0]
    assert not answered
    assert served.node.device_lost
    served.wait_for_log("the device is lost to this process, which ends: torch failed on cuda:0")


def test_concurrent_reloads_both_hold_in_the_end(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("active")
    changes = [served.begin_set(image_size=320), served.begin_set(weights="/other.pt")]
    for change in changes:
        served.wait_for(change.done, "both reloads")
        assert change.result().result.successful
    assert (served.get("image_size"), served.get("weights")) == (320, "/other.pt")
    assert [runtime.is_closed for runtime in prepare.runtimes[:-1]] == [True] * (len(prepare.runtimes) - 1)
    assert not prepare.running.is_closed


@pytest.mark.parametrize("label", ["deactivate", "shutdown"])
def test_leaving_active_wins_over_a_reload(served: ServedNode, prepare: Preparations, label: str) -> None:
    served.bring_to("active")
    prepare.gate.clear()
    change = served.begin_set(image_size=320)
    prepare.begun.acquire(timeout=10)
    assert prepare.begun.acquire(timeout=10)
    assert served.transition(label)
    prepare.gate.set()
    served.wait_for(change.done, "the reload")
    assert not change.result().result.successful
    assert "left the active state" in change.result().result.reason
    assert served.get("image_size") == 640
    assert all(runtime.is_closed for runtime in prepare.runtimes)


def test_several_reload_settings_at_once_load_one_model(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("active")
    assert served.set(image_size=320, weights="/other.pt", confidence_threshold=0.5) == (True, "")
    assert len(prepare.runtimes) == 2


def test_an_atomic_change_is_all_or_nothing(served: ServedNode) -> None:
    served.bring_to("active")
    done, reason = served.set(confidence_threshold=0.5, classes=["bird"])
    assert not done
    assert "bird" in reason
    assert served.get("confidence_threshold") == 0.25


@pytest.mark.parametrize(
    "value",
    [
        pytest.param(ParameterValue(type=42), id="type-that-does-not-exist"),
        pytest.param(ParameterValue(type=0), id="deletion"),
        pytest.param(ParameterValue(type=4, string_value="high"), id="text-for-number"),
        pytest.param(ParameterValue(type=3, double_value=float("nan")), id="nan"),
        pytest.param(ParameterValue(type=3, double_value=float("inf")), id="infinity"),
        pytest.param(ParameterValue(type=8, double_array_value=[0.5] * 100_000), id="huge-array"),
        pytest.param(ParameterValue(type=4, string_value="x" * 1_000_000), id="huge-text"),
    ],
)
@pytest.mark.parametrize("state", STATES)
def test_a_malformed_value_is_refused_in_every_state(
    served: ServedNode, state: str, value: ParameterValue
) -> None:
    served.bring_to(state)
    (result,) = served.set_one_by_one([ParameterMessage(name="confidence_threshold", value=value)])
    assert not result.successful
    assert result.reason
    assert served.get("confidence_threshold") == 0.25


@pytest.mark.parametrize("state", STATES)
def test_an_unknown_parameter_is_refused_in_every_state(served: ServedNode, state: str) -> None:
    served.bring_to(state)
    done, reason = served.set(confidence_treshold=0.5)
    assert not done
    assert "Did you mean 'confidence_threshold'?" in reason


@pytest.mark.parametrize(
    "values",
    [{"autostart": True}, {"bond_timeout": 4.0}, {"weights_dirs": ["/"]}, {"autostart": True, "lazy": False}],
    ids=str,
)
def test_a_setting_that_is_read_only_cannot_be_set(served: ServedNode, values: dict[str, object]) -> None:
    done, reason = served.set(**values)
    assert not done
    assert "read-only" in reason
    assert [served.get(name) for name in ("autostart", "weights_dirs", "lazy")] == [False, [], True]


@pytest.mark.parametrize("state", ["unconfigured", "active"])
def test_every_parameter_may_be_set_to_what_it_is(served: ServedNode, state: str) -> None:
    served.bring_to(state)
    foreign = ["use_sim_time", "start_type_description_service"]
    values = {name: served.get(name) for name in [*(setting.name for setting in SETTINGS), *foreign]}
    results = served.set_one_by_one(
        [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    )
    assert [result.reason for result in results if not result.successful] == []
    assert served.set(**values) == (True, "")


@pytest.mark.parametrize(
    ("parameter", "mended"),
    [
        pytest.param("confidence_threshold:=1.5", {"confidence_threshold": 0.5}, id="out-of-range"),
        pytest.param("lazy:=high", {"lazy": True}, id="wrong-type"),
        pytest.param("confidence_treshold:=0.5", {"confidence_threshold": 0.5}, id="unknown-name"),
        pytest.param("model_size:=nano", {"model_size": "n"}, id="no-such-choice"),
    ],
)
def test_a_bad_override_fails_configure_until_it_is_mended(
    prepare: Preparations, parameter: str, mended: dict[str, object]
) -> None:
    with ServedNode(prepare, parameters=[parameter]) as served:
        assert not served.transition("configure")
        assert parameter.partition(":=")[0] in served.status().message
        assert served.set(**mended) == (True, "")
        assert served.transition("configure")
        assert served.escaped == []


def test_an_unknown_override_may_be_deleted(prepare: Preparations) -> None:
    with ServedNode(prepare, parameters=["colour:=red"]) as served:
        assert not served.transition("configure")
        (result,) = served.set_one_by_one([ParameterMessage(name="colour")])
        assert result.successful
        assert served.transition("configure")


def test_deleting_an_unknown_override_leaves_the_rest_of_the_request_to_be_set(prepare: Preparations) -> None:
    deletion = ParameterMessage(name="colour")
    with ServedNode(prepare, parameters=["colour:=red"]) as served:
        bad = Parameter("confidence_threshold", value=7.0).to_parameter_msg()
        assert not served.set_messages([deletion, bad])[0]
        assert not served.transition("configure")
        good = Parameter("confidence_threshold", value=0.7).to_parameter_msg()
        assert served.set_messages([deletion, good]) == (True, "")
        assert served.get("confidence_threshold") == 0.7
        assert served.transition("configure")


@pytest.mark.parametrize(
    ("parameter", "name", "value"),
    [
        pytest.param("confidence_threshold:=1", "confidence_threshold", 1.0, id="whole-number"),
        pytest.param("device:=0", "device", "0", id="device-index"),
        pytest.param("classes:=[]", "classes", [], id="empty-list"),
        pytest.param("classes:=[0, 1]", "classes", ["0", "1"], id="class-indices"),
        pytest.param("classes:=[cat]", "classes", ["cat"], id="class-names"),
        pytest.param("model_size:=n", "model_size", "n", id="n-that-yaml-takes-for-no"),
    ],
)
def test_an_override_is_taken_as_it_is_meant(
    prepare: Preparations, parameter: str, name: str, value: object
) -> None:
    with ServedNode(prepare, parameters=[parameter]) as served:
        assert served.transition("configure")
        assert served.get(name) == value


# Frames


def test_a_rejected_image_is_counted_and_the_next_one_detected(served: ServedNode) -> None:
    served.bring_to("active")
    served.publish(image(encoding="nonsense"))
    served.wait_for(lambda: served.counts()["rejected"] == 1, "the rejection")
    assert "'nonsense' is not supported" in served.diagnostics[-1].status[0].message
    assert class_ids_of(served.detect()) == ["cat"]
    counts = served.counts()
    assert counts.pop("received") == sum(counts.values())


def test_rejected_images_do_not_flood_the_log(served: ServedNode) -> None:
    served.bring_to("active")
    begun_s = time.monotonic()

    def are_rejected() -> bool:
        served.images.publish(image(encoding="nonsense"))
        values = {item.key: item.value for item in served.diagnostics[-1].status[0].values}
        return int(values["frames rejected"]) >= 100

    served.status()
    served.wait_for(are_rejected, "a hundred rejections")
    counts = served.counts()
    assert counts["received"] == counts["rejected"] + counts["stale"] + counts["pending"]
    assert not served.transition("nonsense")
    served.wait_for_log("'nonsense' refused")
    most = (time.monotonic() - begun_s) / 5 + 1
    assert 1 <= sum("image rejected: " in said for said in served.log) <= most


def fail() -> np.ndarray:
    raise RuntimeError("the device is on fire")


def test_failures_in_a_row_deactivate_the_node_with_the_reason(
    served: ServedNode, prepare: Preparations
) -> None:
    served.bring_to("active")
    assert served.set(max_consecutive_failures=2) == (True, "")
    prepare.running.run = fail
    served.send_until(lambda: served.node.state_label == "inactive", "the node to give up")
    status = served.status()
    assert status.message == "deactivated after 2 failed frames in a row, the last: " + (
        "RuntimeError: the device is on fire"
    )
    assert status.level == DiagnosticStatus.ERROR
    assert prepare.running.is_closed
    assert served.transition("activate")
    assert class_ids_of(served.detect()) == ["cat"]
    assert served.status().level != DiagnosticStatus.ERROR


def test_a_detected_frame_ends_the_count_of_failures(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("active")
    assert served.set(max_consecutive_failures=2) == (True, "")
    runtime = prepare.running

    def fail_every_other_time() -> np.ndarray:
        return fail() if len(runtime.calls) % 2 else prediction("cat", 0.9)

    runtime.run = fail_every_other_time
    served.send_until(lambda: len(runtime.calls) >= 8, "eight frames")
    assert served.state() == "active"


def test_a_hung_inference_does_not_hold_deactivate(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("active")
    entered, release = threading.Event(), threading.Event()

    def hang() -> np.ndarray:
        entered.set()
        release.wait(30)
        return prediction("cat", 0.9)

    prepare.running.run = hang
    served.publish()
    served.wait_for(entered.is_set, "inference to hang")
    assert served.state() == "active"
    hint = "inference of one image takes more than 2 s: the model is too slow for this machine, or it hangs"
    served.wait_for(lambda: hint in served.status().message, "the hint")
    served.wait_for_log(hint)
    begun_s = time.monotonic()
    assert served.transition("deactivate")
    assert REST_TIMEOUT_S <= time.monotonic() - begun_s < 3 * REST_TIMEOUT_S
    given_up = f"inference did not end within {REST_TIMEOUT_S:g} s: its thread was abandoned"
    assert served.status().message == given_up
    served.wait_for_log(given_up)
    release.set()
    assert served.transition("activate")
    assert class_ids_of(served.detect()) == ["cat"]


def test_detections_carry_the_header_of_their_image(served: ServedNode) -> None:
    served.bring_to("active")
    message = image()
    message.header.frame_id = "front"
    message.header.stamp.sec, message.header.stamp.nanosec = 12, 34
    served.publish(message)
    served.wait_for(lambda: bool(served.detections), "a detection")
    array = served.detections[0]
    assert array.header == message.header
    assert [detection.header for detection in array.detections] == [message.header]
    assert array.detections[0].id == ""
    assert (array.detections[0].bbox.size_x, array.detections[0].bbox.size_y) == pytest.approx((2, 1))


def test_labels_are_latched_with_the_threshold_in_force(served: ServedNode) -> None:
    served.bring_to("active")
    info = served.label_info()
    assert [(label.class_id, label.class_name) for label in info.class_map] == [(0, "cat"), (1, "dog")]
    assert info.threshold == pytest.approx(0.25)
    served.set(confidence_threshold=0.5)
    assert served.label_info().threshold == pytest.approx(0.5)


def test_without_listeners_a_lazy_node_does_not_subscribe(served: ServedNode) -> None:
    served.bring_to("active")
    served.publish()
    for subscription in list(served.client.subscriptions):
        if subscription.topic == "/yolov5/detections":
            served.client.destroy_subscription(subscription)
    served.wait_for(lambda: served.images.get_subscription_count() == 0, "the node to unsubscribe")
    assert "no subscribers" in served.status().message
    assert served.set(lazy=False) == (True, "")
    served.wait_for(lambda: served.images.get_subscription_count() == 1, "the node to subscribe")


def test_diagnostics_come_in_every_state(served: ServedNode) -> None:
    assert served.status().message.startswith("unconfigured: ")
    served.bring_to("active")
    assert served.state() == "active"
    values = served.values()
    assert values["state"] == "active"
    assert values["runtime"] == "scripted"
    assert values["sha256"] == "0" * 64


def test_each_reason_for_silence_is_told_while_it_lasts(prepare: Preparations) -> None:
    with ServedNode(prepare, arguments=["--ros-args", "-r", "~/image_raw:=/front"]) as served:

        def is_told(reason: str) -> Callable[[], bool]:
            return lambda: reason in served.status().message

        served.bring_to("active")
        served.wait_for(is_told("no publisher of images on /front"), "the missing camera")
        best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        camera = served.client.create_publisher(Image, "/front", best_effort)
        assert served.set(image_reliability="reliable") == (True, "")
        served.wait_for(is_told("a best-effort publisher on /front does not match"), "the mismatch")
        assert served.set(image_reliability="auto") == (True, "")
        assert served.set(confidence_threshold=0.95) == (True, "")

        def is_empty() -> bool:
            camera.publish(image())
            return int(served.values()["empty frames in a row"]) > 0

        served.wait_for(is_empty, "a frame without detections")
        assert served.values()["best score in them"] == "0.9"


def test_a_compressed_camera_is_understood(served: ServedNode) -> None:
    served.bring_to("active")
    assert served.set(image_transport="compressed") == (True, "")
    done, data = cv2.imencode(".jpg", np.full((48, 64, 3), 114, np.uint8))
    assert done
    message = CompressedImage(format="jpeg", data=data.tobytes())
    publisher = served.client.create_publisher(CompressedImage, "/yolov5/image_raw/compressed", 1)

    def is_detected() -> bool:
        publisher.publish(message)
        return bool(served.detections)

    served.wait_for(is_detected, "a detection")
    assert class_ids_of(served.detections[-1]) == ["cat"]


def test_who_listens_to_the_compressed_image_alone_gets_it(served: ServedNode) -> None:
    served.bring_to("active")
    drawn: list[CompressedImage] = []
    served.client.create_subscription(CompressedImage, "/yolov5/image/compressed", drawn.append, 1)
    for subscription in list(served.client.subscriptions):
        if subscription.topic == "/yolov5/detections":
            served.client.destroy_subscription(subscription)
    served.send_until(lambda: bool(drawn), "a compressed image")
    assert picture(drawn[0]).size_hw == (48, 64)


def test_the_subscription_takes_the_reliability_that_the_cameras_offer(served: ServedNode) -> None:
    served.bring_to("active")
    served.detect()
    served.wait_for(lambda: served.values()["image reliability"] == "reliable", "a reliable subscription")
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    served.client.create_publisher(Image, "/yolov5/image_raw", best_effort)
    served.wait_for(lambda: served.values()["image reliability"] == "best_effort", "best effort")
    assert class_ids_of(served.detect()) == ["cat"]


def test_a_rate_limit_skips_and_counts_the_frames_between(served: ServedNode) -> None:
    served.bring_to("active")
    assert served.set(max_rate=1.0) == (True, "")
    served.detect()
    served.detect()
    counts = served.counts()
    assert counts["skipped"] > 0
    assert counts["received"] == sum(counts.values()) - counts["received"]


def test_the_compressed_topic_follows_the_remapped_raw_one(prepare: Preparations) -> None:
    arguments = ["--ros-args", "-r", "~/image_raw:=/front/image"]
    with ServedNode(prepare, parameters=["image_transport:=compressed"], arguments=arguments) as served:
        served.bring_to("active")
        assert served.values()["image topic"] == "/front/image/compressed"
