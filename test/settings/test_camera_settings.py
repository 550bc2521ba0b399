"""Settings of several cameras: their names, overrides, and what each camera gets."""

from __future__ import annotations

from typing import Any

import pytest

from yolov5_lifecycle.detection.class_filter import model_problems
from yolov5_lifecycle.ros.topics import published, subscribed
from yolov5_lifecycle.settings.camera_overrides import MAX_CAMERAS
from yolov5_lifecycle.settings.schema import Change, SettingsError
from yolov5_lifecycle.settings.settings import SETTINGS, validated
from yolov5_lifecycle.settings.suggestion import MAX_UNKNOWN

FRONT_AND_REAR: dict[str, Any] = {"cameras": ("front", "rear")}


def problems(values: dict[str, Any]) -> list[str]:
    with pytest.raises(SettingsError) as refusal:
        validated(values)
    return [str(problem) for problem in refusal.value.problems]


@pytest.mark.parametrize(
    "names",
    [
        pytest.param(("Front", "front", "f", "front_2", "front_"), id="alike"),
        pytest.param(("a" * 64,), id="long"),
        pytest.param(tuple(f"camera{number}" for number in range(MAX_CAMERAS)), id="many"),
    ],
)
def test_cameras_have_names(names: tuple[str, ...]) -> None:
    assert validated({"cameras": names}).camera_names == names


@pytest.mark.parametrize(
    ("names", "problem"),
    [
        pytest.param(("",), "begin with a letter: rename ''", id="empty"),
        pytest.param(("my__camera",), "single underscores that begin with a letter: rename 'my__", id="two"),
        pytest.param(("front.left",), "rename 'front.left'", id="dot"),
        pytest.param(("front\n",), r"rename 'front\n'", id="line-end"),
        pytest.param(
            ("a" * 65,),
            "at most 64 letters, digits and single underscores that begin with a letter: "
            f"rename '{'a' * 65}'.",
            id="long",
        ),
        pytest.param(("front", "rear", "front"), "each camera once: leave out one 'front'", id="repeated"),
        pytest.param(("image",), "must not hold 'image', the name of a topic", id="topic"),
        pytest.param(("detection",), "'detection', the name of the status of the node in", id="status"),
        pytest.param(("qos_overrides",), "the name of a parameter of ROS: rename that", id="qos"),
        pytest.param(tuple(f"c{number}" for number in range(17)), "a list of at most 16 strings", id="17"),
    ],
)
def test_a_name_that_cannot_be_that_of_a_camera_is_refused(names: Any, problem: str) -> None:
    (found,) = problems({"cameras": names})
    assert found.startswith("cameras: ")
    assert problem in found
    assert len(found) < 500


def test_no_setting_may_be_the_name_of_a_camera() -> None:
    for setting in SETTINGS:
        assert "the name of a setting" in problems({"cameras": (setting.name,)})[0]


def test_no_part_of_a_topic_name_may_be_the_name_of_a_camera() -> None:
    for topic in (*published(("",)), *subscribed(("",))):
        assert problems({"cameras": (topic.split("/")[1],)})[0].startswith("cameras: "), topic


def test_settings_that_concern_one_camera_may_be_overridden() -> None:
    of_cameras = {setting.name for setting in SETTINGS if setting.per_camera}
    kinds = (Change.LIVE, Change.RESUBSCRIBE)
    assert of_cameras == {s.name for s in SETTINGS if s.change in kinds} - {"max_consecutive_failures"}


def test_a_camera_inherits_what_is_not_overridden() -> None:
    given = {"classes": ["cat"], "max_rate": 5, "device": "cpu", "front.max_rate": 2, "front.classes": []}
    settings = validated({**FRONT_AND_REAR, **given})
    of_node = {"classes": ("cat",), "max_rate": 5.0, "device": "cpu"}
    assert settings.for_camera("rear") == validated(of_node)
    assert settings.for_camera("front") == validated({**of_node, "classes": (), "max_rate": 2.0})


@pytest.mark.parametrize(
    ("overrides", "kind", "names"),
    [
        pytest.param({"front.max_rate": 2.0}, Change.LIVE, ["front.max_rate"], id="changed"),
        pytest.param({"front.max_rate": 1.0, "rear.lazy": True}, Change.LIVE, ["rear.lazy"], id="added"),
        pytest.param({}, Change.LIVE, ["front.max_rate"], id="removed"),
        pytest.param({"rear.depth": True}, Change.RESUBSCRIBE, ["rear.depth"], id="resubscribed"),
    ],
)
def test_differing_names_overrides(overrides: dict[str, Any], kind: Change, names: list[str]) -> None:
    before = validated({**FRONT_AND_REAR, "front.max_rate": 1.0})
    assert before.differing(validated({**FRONT_AND_REAR, **overrides}), kind) == names


def test_the_digest_covers_overrides_in_any_order() -> None:
    values = {**FRONT_AND_REAR, "front.max_rate": 2.0, "rear.lazy": False}
    settings = validated(values)
    assert settings.digest() == validated(dict(reversed(values.items()))).digest()
    assert settings.digest() != validated(FRONT_AND_REAR).digest()
    assert settings.digest() != validated({**values, "front.max_rate": 3.0}).digest()


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        pytest.param({"front.max_rate": -1.0}, "front.max_rate: -1.0 is not a number from 0", id="range"),
        pytest.param({"front.max_rte": 1.0}, "front.max_rte: .*Did you mean 'front.max_rate'", id="setting"),
        pytest.param({"frnt.max_rate": 1.0}, "frnt.max_rate: .*Did you mean 'front.max_rate'", id="camera"),
        pytest.param({"front.imgsz": 320}, "there is no such parameter\\.$", id="of-the-node-elsewhere"),
        pytest.param({"imgsz": 320}, "imgsz: .*Did you mean 'image_size'", id="of-the-node"),
        pytest.param({"front.weights": "x"}, "weights is a setting of the node, the same for all", id="node"),
        pytest.param({"side.lazy": True}, "add the camera to cameras, which has front, rear", id="absent"),
        pytest.param({".lazy": True}, ".lazy: there is no such parameter", id="nameless"),
        pytest.param(
            {"front": {}}, "front is a camera; its settings have names such as front.", id="camera-alone"
        ),
    ],
)
def test_a_wrong_override_is_refused_with_what_was_meant(values: dict[str, Any], problem: str) -> None:
    with pytest.raises(SettingsError, match=problem) as refusal:
        validated({**FRONT_AND_REAR, **values})
    assert len(refusal.value.problems) == 1


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        pytest.param("front.max_rate", "add the camera to cameras, which names none.", id="override"),
        pytest.param("foo.bar", "there is no such parameter.", id="other"),
        pytest.param(
            "class_thresholds.person",
            "class_thresholds is a list of at most 10000 strings, without names below it.",
            id="part",
        ),
    ],
)
def test_without_cameras_there_are_no_overrides(name: str, reason: str) -> None:
    (problem,) = problems({name: 1.0})
    assert problem.endswith(reason)


def test_of_very_many_overrides_of_absent_cameras_the_first_are_explained() -> None:
    told = problems({f"side{number}.max_rate": -1.0 for number in range(2 * MAX_UNKNOWN)})
    assert len(told) == 2 * MAX_UNKNOWN + 1
    assert f"and {MAX_UNKNOWN} more: there are no such parameters." in told


def test_what_a_camera_overrides_may_contradict_what_it_inherits() -> None:
    (problem,) = problems({**FRONT_AND_REAR, "track_low_threshold": 0.2, "front.track_high_threshold": 0.15})
    assert problem.startswith("front.track_low_threshold: 0.2 is above")


def test_a_problem_of_the_node_is_not_repeated_for_every_camera() -> None:
    values = {"track_low_threshold": 0.3, "front.lazy": True, "rear.lazy": True}
    assert len(problems({**FRONT_AND_REAR, **values})) == 1


def test_every_problem_is_reported_at_once() -> None:
    of_node = {"max_rate": -1.0, "image_size": 7, "wieghts": "x"}
    values = {**of_node, "front.lazy": 1, "rear.depth": 1, "side.lazy": True}
    names = [problem.partition(":")[0] for problem in problems({**FRONT_AND_REAR, **values})]
    assert names == ["image_size", "max_rate", "wieghts", "front.lazy", "rear.depth", "side.lazy"]


# With the classes of a model


@pytest.mark.parametrize(
    ("values", "names"),
    [
        pytest.param({"classes": ["cat"], "front.classes": [], "rear.classes": ["dog"]}, [], id="known"),
        pytest.param({"classes": ["cow"]}, ["classes"], id="inherited"),
        pytest.param(
            {"classes": ["cow"], "front.classes": ["pig"], "rear.classes": ["cow"]},
            ["classes", "front.classes"],
            id="both",
        ),
        pytest.param({"collect_reasons": ["novel", "class: cow"]}, ["collect_reasons"], id="reason"),
        pytest.param(
            {"class_thresholds": ["cat: 0.5"], "rear.class_thresholds": ["cat: 0.5", "0: 0.4"]},
            ["rear.class_thresholds"],
            id="overridden-threshold",
        ),
    ],
)
def test_the_classes_of_every_camera_must_be_those_of_the_model(
    values: dict[str, Any], names: list[str]
) -> None:
    found = model_problems(validated({**FRONT_AND_REAR, **values}), ("cat", "dog"))
    assert [problem.setting for problem in found] == names
