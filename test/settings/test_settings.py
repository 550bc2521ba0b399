"""Settings: every rule, every message, one source."""

from __future__ import annotations

import math
import sys

import pytest
from support.started import printed_by

from yolov5_lifecycle.settings.schema import SettingsError
from yolov5_lifecycle.settings.settings import SCHEMA, SETTINGS, SETTINGS_BY_NAME, Settings, validated
from yolov5_lifecycle.settings.synonyms import NOT_SETTINGS, SYNONYMS


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        pytest.param({"confidence_threshold": 1.5}, "1.5 is not a number from 0 to 1", id="above-range"),
        pytest.param({"confidence_threshold": math.nan}, "nan is not a number", id="nan"),
        pytest.param({"confidence_threshold": True}, "true is not a number", id="bool-for-number"),
        pytest.param({"image_size": 650}, "a multiple of 32", id="no-multiple-of-a-stride"),
        pytest.param({"model_size": "xl"}, "Did you mean 'x'?", id="misspelt-choice"),
        pytest.param({"device": "gpu"}, "Did you mean 'cuda'?", id="gpu"),
        pytest.param({"device": "cuda:one"}, "must be auto, cpu, cuda", id="device-index-in-words"),
        pytest.param({"weights_sha256": "abc"}, "64 hexadecimal digits", id="short-digest"),
        pytest.param({"weights_dirs": ("/a", "b")}, "['/a', 'b'] must be absolute", id="relative-folder"),
        pytest.param({"classes": ("a", 3)}, "['a', 3] is not a list of at most", id="number-among-classes"),
        pytest.param({"autostart": "yes"}, "restart the node with another value", id="read-only"),
        pytest.param({"classes": "[2, square]"}, 'Did you mean ["2", square]?', id="index-and-name"),
        pytest.param({"classes": "[zebra é]"}, 'Did you mean ["zebra é"]?', id="name-with-accent"),
        pytest.param({"classes": ("a",) * 10_001}, "a list of at most 10000 strings", id="huge-list"),
        pytest.param({"classes": ("cat", "x" * 201)}, "of at most 200 characters", id="long-class"),
        pytest.param(
            {"class_thresholds": ("x" * 201 + ": 0.5",)}, "with more than 200 characters", id="long-threshold"
        ),
        pytest.param({"class_thresholds": ("person",)}, "'person' is not a class name", id="no-threshold"),
        pytest.param({"class_thresholds": (": 0.5",)}, "': 0.5' is not a class name", id="nameless-class"),
        pytest.param({"class_thresholds": ("a: 1.5",)}, "a number from 0 to 1, as in", id="high-threshold"),
        pytest.param({"class_thresholds": ("a: 0_1",)}, "'a: 0_1' is not a class name", id="no-number"),
        pytest.param(
            {"class_thresholds": ("a: 0.5", " a :0.4")}, "'a' has more than one threshold", id="twice"
        ),
        pytest.param({"collect_reasons": ("unusal",)}, "Did you mean 'unusual'?", id="reason"),
        pytest.param({"collect_reasons": ("class: ",)}, "as in 'class: person'", id="reason-without-class"),
        pytest.param({"collect_reasons": ("class:" + "x" * 201,)}, "most 200 characters", id="long-reason"),
        pytest.param({"regions": ("0,0 1,0 1,1", "0,0 1,1")}, "entry 2 has 2 points", id="second-region"),
        pytest.param({"regions": ("0.1", "0.2 0.9", "1")}, "entry 1 has '0.1' as point 1", id="split"),
        pytest.param({"ignore_regions": ("0,0 2,0 1,1",)}, "entry 1 has point 2 at 2,0", id="outside"),
        pytest.param({"regions": "[0,0 1,0 1,1]"}, 'Did you mean ["0,0 1,0 1,1"]?', id="region-unquoted"),
        pytest.param({"weights_dir": ""}, "'' is not a string of 1 to 4096 characters", id="empty-folder"),
    ],
)
def test_a_broken_rule_is_named_with_field_value_and_rule(values: dict[str, object], problem: str) -> None:
    with pytest.raises(SettingsError) as refusal:
        validated(values)
    (found,) = refusal.value.problems
    assert found.setting == next(iter(values))
    assert problem in found.message


@pytest.mark.parametrize(
    "value",
    ["x" * 1_000_000, ("x" * 1_000_000,) * 3, ("\n",) * 10_000],
    ids=["a string", "long strings", "many strings"],
)
def test_a_refusal_is_short_whatever_was_given(value: object) -> None:
    for name in SETTINGS_BY_NAME:
        assert len(str(SCHEMA.problem(name, value))) < 500, name


def test_an_unknown_name_is_shown_in_one_short_line() -> None:
    problem = str(SCHEMA.unknown("a\n\x1b[31m" + "x" * 1_000_000))
    assert problem.startswith("a ?[31mxxx")
    assert len(problem) < 200


def test_a_parameter_name_of_another_node_is_answered_with_ours() -> None:
    assert set(SYNONYMS.values()) <= set(SETTINGS_BY_NAME)
    assert not (SYNONYMS.keys() | NOT_SETTINGS) & SETTINGS_BY_NAME.keys()
    with pytest.raises(SettingsError, match=r"conf_thres: .* Did you mean 'confidence_threshold'\?"):
        validated({"conf_thres": 1})


def test_an_option_that_is_no_parameter_is_answered_with_its_replacement() -> None:
    with pytest.raises(SettingsError) as refusal:
        validated({"image_topic": "x"})
    assert str(refusal.value) == (
        "image_topic: there is no such parameter: topics are remapped: -r '~/image_raw:=/camera/image_raw'."
    )


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        pytest.param({"device": "cpu", "precision": "fp16"}, "fp16.*device is 'cpu'", id="half-on-cpu"),
        pytest.param({"device": "cuda", "precision": "int8"}, "int8.*device is 'cuda'", id="int8-on-gpu"),
        pytest.param(
            {"runtime": "torch", "precision": "int8"}, "int8.*runtime is 'torch'", id="int8-in-torch"
        ),
        pytest.param({"model_size": "n6", "image_size": 672}, "multiple of 64.*640 or 704", id="p6-stride"),
        pytest.param(
            {"track_low_threshold": 0.3}, "track_low_threshold: 0.3 is above track_high.*0.25", id="low-track"
        ),
        pytest.param(
            {"min_box_size": 0.5, "max_box_size": 0.4}, "0.5 is above max_box_size, 0.4", id="sizes-fractions"
        ),
    ],
)
def test_settings_that_contradict_each_other_are_refused(values: dict[str, object], problem: str) -> None:
    with pytest.raises(SettingsError, match=problem) as refusal:
        validated(values)
    assert refusal.value.problems[0].setting in values


def test_a_tracker_without_scipy_is_refused_with_the_remedy() -> None:
    program = (
        "import sys; sys.modules['scipy'] = None\n"
        "from yolov5_lifecycle.settings.settings import validated\n"
        "validated({'tracker': 'none'})\n"
        "try:\n    validated({'tracker': 'bytetrack'})\n"
        "except ValueError as error:\n    print(error)\n"
    )
    told = printed_by(program)
    assert told.startswith("tracker: 'bytetrack' needs scipy. ")
    assert f"{sys.executable} -m pip install scipy" in told
    assert told.endswith("sudo apt install python3-scipy, or use the tracker 'none'.\n")


OF_FILE = {"weights": "mine.pt", "model_size": "n6", "image_size": 672}


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        pytest.param({"device": "0"}, {"device": "cuda:0"}, id="bare-index-is-cuda"),
        *(
            pytest.param({"weights_dirs": [folder]}, {"weights_dirs": (folder,)}, id=folder)
            for folder in ("/models", "~/models", "package://robot/models")
        ),
        pytest.param(
            {"min_box_size": 9, "max_box_size": 0.5}, {"min_box_size": 9.0, "max_box_size": 0.5}, id="units"
        ),
        pytest.param({"min_box_size": 9.0}, {"min_box_size": 9.0}, id="no-maximum"),
        pytest.param({"collect_dir": "~/kept"}, {"collect_dir": "~/kept"}, id="below-home"),
        pytest.param(OF_FILE, OF_FILE, id="stride-of-a-named-weights-file"),
        pytest.param({"weights_sha256": "AB" * 32}, {"weights_sha256": "ab" * 32}, id="digest-in-capitals"),
    ],
)
def test_what_is_plainly_meant_is_accepted(given: dict[str, object], kept: dict[str, object]) -> None:
    settings = validated(given)
    assert settings.model_dump() == Settings().model_dump() | kept
    assert validated(settings.model_dump()) == settings


def test_every_setting_says_what_a_user_needs() -> None:
    for setting in SETTINGS:
        assert setting.description.endswith("."), setting.name
        assert "None" not in setting.allowed, setting.name
        assert (setting.minimum is None) == (setting.maximum is None), setting.name
        assert validated({setting.name: setting.default}) == Settings(), setting.name
