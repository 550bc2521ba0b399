"""What a page of the console is told about detectors, and what it does to them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from support.console_fixtures import ConsoleBesideNode, console_beside_node
from support.console_process import ConsoleClient, Page, address, console_process
from support.detector_process import NODE
from support.preparations import Preparations
from support.served_node import ServedNode

from yolov5_lifecycle.settings.settings import SETTINGS


@pytest.fixture(scope="module")
def console() -> Iterator[ConsoleBesideNode]:
    with console_beside_node() as beside:
        yield beside


@pytest.fixture
def page(console: ConsoleBesideNode) -> Iterator[Page]:
    """A page that shows the detector, unconfigured, with its parameters as at the start."""
    console.prepare.refusal = ""
    for state, step in (("active", "deactivate"), ("inactive", "cleanup")):
        assert console.served.state() != state or console.served.transition(step)
    with console.client.page() as page:
        page.wait_for(lambda: NODE in page.nodes, "the detector")
        page.wait_for_state("unconfigured")
        yield page


def wait_for_value(page: Page, name: str, value: object) -> None:
    page.wait_for(lambda: page.parameter(name)["value"] == value, f"{name} {value}")


def wait_until_busy(page: Page, busy: str) -> None:
    page.wait_for(lambda: NODE in page.nodes and page.nodes[NODE]["busy"] == busy, "a busy node")


def parameter_names(page: Page) -> list[str]:
    return [one["name"] for one in page.nodes[NODE]["parameters"]]


def test_a_page_is_welcomed_and_told_of_each_detector(console: ConsoleBesideNode, page: Page) -> None:
    with console.client.page() as late:
        assert NODE in late.welcome.pop("nodes")
        assert late.welcome == {"type": "welcome", "view_only": False}
    node = page.nodes[NODE]
    assert node["transitions"] == [{"label": "configure"}, {"label": "shutdown"}]
    assert [one["name"] for one in node["parameters"]] == [setting.name for setting in SETTINGS]
    assert [camera["name"] for camera in node["cameras"]] == [""]
    assert node["diagnostics"][0]["name"] == "detection"
    assert node["diagnostics"][0]["values"]["state"] == "unconfigured"
    assert node["busy"] == ""


def test_a_client_that_is_no_detector_is_not_shown(page: Page) -> None:
    assert [*page.nodes] == [NODE]


def test_transitions_are_followed_and_change_what_is_possible(page: Page) -> None:
    assert page.transition("configure") == ""
    page.wait_for_state("inactive")
    assert page.transition("activate") == ""
    node = page.wait_for_state("active")
    assert {"label": "deactivate"} in node["transitions"]
    page.wait_for(lambda: page.nodes[NODE]["class_names"] == ["cat", "dog"], "the names of the classes")


def test_a_transition_of_somebody_else_is_shown(console: ConsoleBesideNode, page: Page) -> None:
    assert console.served.transition("configure")
    page.wait_for_state("inactive")


def test_a_refused_transition_has_the_words_of_the_node(console: ConsoleBesideNode, page: Page) -> None:
    assert page.transition("configure") == ""
    page.wait_for_state("inactive")
    console.prepare.refusal = "the model is on holiday"
    assert "the model is on holiday" in page.transition("activate")
    page.wait_for_state("inactive")
    page.wait_for(
        lambda: any("on holiday" in line["text"] for line in page.nodes[NODE]["log"]), "the line of the log"
    )


def test_an_impossible_transition_is_refused_with_the_possible_ones(page: Page) -> None:
    refusal = page.transition("activate")
    assert refusal == "activate is not possible while unconfigured; possible now: configure, shutdown"


def test_a_change_reaches_the_node_and_all_pages(console: ConsoleBesideNode, page: Page) -> None:
    with console.client.page() as other:
        other.wait_for(lambda: NODE in other.nodes, "the detector")
        assert page.set(confidence_threshold=0.75, classes=["cat"]) == ""
        assert console.served.get("confidence_threshold") == 0.75
        for one in (page, other):
            wait_for_value(one, "confidence_threshold", 0.75)
            wait_for_value(one, "classes", ["cat"])
    assert page.set(confidence_threshold=0.25, classes=[]) == ""


def test_a_change_of_somebody_else_is_shown(console: ConsoleBesideNode, page: Page) -> None:
    assert console.served.set(iou_threshold=0.3) == (True, "")
    wait_for_value(page, "iou_threshold", 0.3)
    assert page.set(iou_threshold=0.45) == ""


def test_regions_and_thresholds_of_classes_are_lists_that_a_page_may_set(page: Page) -> None:
    values = {"regions": ["0,0.5 1,0.5 1,1 0,1", "0,0 0.5,0 0.5,0.5"], "class_thresholds": ["cat: 0.5"]}
    for name, value in values.items():
        assert page.parameter(name)["type"] == "string_array"
        assert page.set(**{name: value}) == ""
        wait_for_value(page, name, value)
        assert page.set(**{name: []}) == ""


@pytest.mark.parametrize(
    ("values", "words"),
    [
        pytest.param({"confidence_threshold": 7}, "7.0 is not a number from 0 to 1", id="range"),
        pytest.param({"confidence_treshold": 0.5}, "Did you mean 'confidence_threshold'?", id="name"),
        pytest.param({"autostart": True}, "read-only", id="read-only"),
        pytest.param({"iou_threshold": 0.9, "max_rate": -1.0}, "max_rate", id="one of two"),
        pytest.param({"lazy": "yes"}, "lazy: expected true or false", id="type"),
        pytest.param({"regions": ["0,0 1,1"]}, "entry 1 has 2 points", id="region"),
    ],
)  # fmt: skip
def test_a_refused_change_has_the_words_of_the_node(
    page: Page, values: dict[str, object], words: str
) -> None:
    before = page.parameter("iou_threshold")["value"]
    assert words in page.set(**values)
    assert page.parameter("iou_threshold")["value"] == before


def test_the_last_of_many_changes_is_what_stays(console: ConsoleBesideNode, page: Page) -> None:
    values = [round(0.3 + 0.01 * number, 2) for number in range(40)]
    for batch in (values[:7], values[7:14]):
        numbers = [page.begin(type="set", values={"confidence_threshold": value}) for value in batch]
        page.wait_for(partial(page.answers.keys().__ge__, set(numbers)), "all answers")
        assert console.served.get("confidence_threshold") == batch[-1]


def test_while_a_reload_is_prepared_all_pages_see_that_the_node_is_busy(
    console: ConsoleBesideNode, page: Page
) -> None:
    for label in ("configure", "activate"):
        assert page.transition(label) == ""
    page.wait_for_state("active")
    console.prepare.gate.clear()
    try:
        number = page.begin(type="set", values={"image_size": 320})
        with console.client.page() as other:
            for one in (page, other):
                wait_until_busy(one, "set image_size ...")
    finally:
        console.prepare.gate.set()
    page.wait_for(lambda: number in page.answers, "the answer")
    assert page.answers[number]["ok"]
    page.wait_for(lambda: page.nodes[NODE]["busy"] == "", "a node that is not busy")
    assert page.set(image_size=640) == ""


def test_cameras_are_set_and_their_overrides_come_and_go(console: ConsoleBesideNode, page: Page) -> None:
    assert page.set(cameras=["front", "rear"]) == ""
    page.wait_for(
        lambda: [camera["name"] for camera in page.nodes[NODE]["cameras"]] == ["front", "rear"], "the cameras"
    )
    assert page.set(**{"front.max_rate": 5}) == ""
    page.wait_for(lambda: "front.max_rate" in parameter_names(page), "the override")
    assert page.parameter("front.max_rate")["value"] == 5.0
    assert page.set(**{"front.max_rate": None}) == ""
    page.wait_for(lambda: "front.max_rate" not in parameter_names(page), "no override")
    assert page.set(cameras=[]) == ""


def test_the_balance_grows_while_images_come(console: ConsoleBesideNode, page: Page) -> None:
    assert page.set(lazy=False) == ""
    for label in ("configure", "activate"):
        assert page.transition(label) == ""
    console.served.detect()
    page.wait_for(lambda: page.nodes[NODE]["cameras"][0]["balance"].get("detected", 0) > 0, "the balance")
    camera = page.nodes[NODE]["cameras"][0]
    ends = {name: count for name, count in camera["balance"].items() if name != "received"}
    assert camera["balance"]["received"] == sum(ends.values())
    assert page.set(lazy=True) == ""


@pytest.mark.long
def test_a_page_asks_for_an_image_and_is_told_the_answer_of_the_node(tmp_path: Path) -> None:
    with (
        console_beside_node(parameters=(f"collect_dir:={tmp_path}",)) as beside,
        beside.client.page() as page,
    ):
        page.wait_for_state("unconfigured")
        assert page.ask(type="collect") == "no camera collects: activate the node, and set collect to true"
        assert page.set(collect=True) == ""
        for label in ("configure", "activate"):
            assert page.transition(label) == ""
        number = page.begin(type="collect")
        page.wait_for(lambda: number in page.answers, "the answer")
        expected = {"ok": True, "reason": "", "result": "the next image is kept"}
        assert expected.items() <= page.answers[number].items()


@pytest.mark.parametrize(
    ("message", "words"),
    [
        pytest.param("{", "JSON", id="half"),
        pytest.param("[]", "JSON", id="list"),
        pytest.param("[" * 100_000, "JSON", id="nested"),
        pytest.param('{"type":"set","values":{"max_rate":NaN}}', "JSON", id="NaN"),
        pytest.param('{"type":"reboot"}', "expected the type set, transition or collect", id="type"),
        pytest.param('{"type":"set"}', "expected values", id="no values"),
        pytest.param('{"type":"set","node":"/yolov5","values":{}}', "expected values", id="empty"),
        pytest.param('{"type":"transition","node":"/yolov5","label":7}', "expected label", id="label"),
        pytest.param('{"type":"set","node":"/yolov5","values":{"\\ud800":1}}', "the name", id="name"),
        pytest.param('{"type":"transition","node":"/yolov5","label":"\\ud800"}', "not possible", id="text"),
        pytest.param('{"type":"transition","label":"configure"}', "no detector None", id="no node"),
        pytest.param('{"type":"collect","node":"/yolov5"}', "there is no folder", id="no folder"),
        pytest.param('{"type":"transition","node":"/x","label":"configure"}', "no detector /x", id="node"),
        pytest.param('{"type":"transition","node":["/x"],"label":"configure"}', "no detector", id="list"),
    ],
)  # fmt: skip
def test_a_message_that_is_no_request_is_answered(page: Page, message: str, words: str) -> None:
    page.connection.send(message)
    page.wait_for(lambda: None in page.answers, "an answer")
    answer = page.answers.pop(None)
    assert not answer["ok"]
    assert words in answer["reason"]


def test_the_id_of_a_request_comes_back(page: Page) -> None:
    page.connection.send(json.dumps({"type": "reboot", "id": "a" * 50}))
    page.wait_for(lambda: "a" * 50 in page.answers, "an answer")


def test_the_lines_that_a_detector_logs_before_it_is_known_are_shown(page: Page) -> None:
    page.wait_for(lambda: "next step" in page.nodes[NODE]["log"][0]["text"], "the first line")


@pytest.mark.long
def test_a_detector_that_ends_is_gone_and_comes_back(console: ConsoleBesideNode, page: Page) -> None:
    name = "/second"
    words = ["--ros-args", "-r", "__node:=second"]
    with ServedNode(Preparations(), arguments=words):
        page.wait_for(lambda: name in page.nodes, "the second detector")
    page.wait_for(lambda: page.gone == [name], "the end of the second detector")
    assert page.lost[name]["state"] == "lost"
    assert page.lost[name]["last_state"] == "unconfigured"
    assert page.lost[name]["transitions"] == []
    assert page.ask(type="transition", node=name, label="configure") == f"there is no detector {name}"
    with ServedNode(Preparations(), arguments=[*words, "-p", "max_rate:=3.0"]) as again:
        page.wait_for(lambda: name in page.nodes, "the new detector")
        assert sum("next step" in line["text"] for line in page.nodes[name]["log"]) == 2  # of both processes
        assert page.parameter("max_rate", name)["value"] == 3.0
        assert page.ask(type="transition", node=name, label="configure") == ""
        assert again.node.state_label == "inactive"


@pytest.mark.long
def test_a_detector_that_is_restarted_before_it_is_missed_is_gone_for_a_moment(page: Page) -> None:
    name = "/second"
    words = ["--ros-args", "-r", "__node:=second"]
    with ServedNode(Preparations(), arguments=words):
        page.wait_for(lambda: name in page.nodes, "the detector")
        with ServedNode(Preparations(), arguments=words):
            page.wait_for(lambda: name in page.gone and name in page.nodes, "its new process")
    page.wait_for(lambda: name not in page.nodes, "the end of both")


@pytest.mark.long
def test_only_the_nodes_that_are_asked_for_are_shown(console: ConsoleBesideNode, page: Page) -> None:
    name = "/robot/eyes"
    words = ["--ros-args", "-r", "__node:=eyes", "-r", "__ns:=/robot"]
    with ServedNode(Preparations(), arguments=words):
        page.wait_for(lambda: {NODE, name} <= page.nodes.keys(), "both detectors")
        assert page.ask(type="transition", node=name, label="configure") == ""
        page.wait_for_state("inactive", name)
        assert page.nodes[NODE]["state"] == "unconfigured"
        with (
            console_process(console.domain, "--node", name) as process,
            ConsoleClient(address(process)).page() as chosen,
        ):
            chosen.wait_for(lambda: name in chosen.nodes, "the detector")
            assert [*chosen.nodes] == [name]
    page.wait_for(lambda: name in page.gone, "the end of the second detector")
