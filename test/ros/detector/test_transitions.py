"""Every transition in every state: carried out, or refused without a change."""

from __future__ import annotations

import time

import pytest
from support.preparations import Preparations
from support.served_node import STATES, ServedNode, class_ids_of

LEGAL_NUMBERS = {"unconfigured": (1, 5), "inactive": (3, 2, 6), "active": (4, 7), "finalized": ()}
"""What lifecycle_msgs calls the transitions out of each state."""


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


def test_an_unexpected_exception_in_activate_leads_back_to_unconfigured(ros_domain: int) -> None:
    def broken(settings: object, sizes_hw: object) -> None:
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
    served.wait_for(lambda: served.image_subscriptions() == 0, "the node to unsubscribe")
    served.wait_for(lambda: served.client.count_publishers("/yolov5/detections") == 0, "the publishers to go")
