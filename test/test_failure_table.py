"""Every row of the table of failures in docs/architecture.md is pinned by tests."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from colcon_workspace import REPOSITORY
from test_documentation import table

TESTS = Path(__file__).parent
PINNED = {
    "bad value, unknown parameter or contradiction at configure; weights outside `weights_dirs`; "
    "a parameter file that cannot be parsed; a QoS override that no topic can obey": [
        "test_end_to_end.py::test_every_mistake_in_a_parameter_file_is_named_and_can_be_mended",
        "test_end_to_end.py::test_a_parameter_file_that_cannot_be_parsed_fails_configure",
        "test_node.py::test_a_bad_override_fails_configure_until_it_is_mended",
        "test_node.py::test_an_unknown_override_may_be_deleted",
        "test_qos_overrides.py::test_configure_refuses_a_wrong_override_until_the_next_start",
        "test_confinement.py::test_configure_refuses_weights_from_outside",
        "test_confinement.py::test_folders_that_are_none_hold_configure_until_the_process_is_started_anew",
    ],
    "weights missing, corrupt, hostile or of another kind; device absent; unknown class, at activate": [
        "test_end_to_end.py::test_missing_weights_are_named_with_the_remedy_and_may_be_given_then",
        "test_weights_in_service.py::test_a_bad_file_is_refused_by_activate_and_by_a_swap",
        "test_confinement.py::test_a_running_node_refuses_weights_from_outside",
        "test_end_to_end.py::test_a_parameter_file_is_taken_as_it_is_meant",
        "test_node.py::test_activate_that_cannot_load_says_why_and_stays_inactive",
        "test_node.py::test_activate_refuses_a_class_that_the_model_does_not_have",
    ],
    "the same in a reload": [
        "test_weights_in_service.py::test_a_bad_file_is_refused_by_activate_and_by_a_swap",
        "test_weights_in_service.py::test_a_swap_to_a_model_without_a_filtered_class_is_explained",
        "test_confinement.py::test_a_running_node_refuses_weights_from_outside",
        "test_node.py::test_a_refused_reload_leaves_model_and_value_alone",
    ],
    "unexpected exception in a transition": [
        "test_node.py::test_an_unexpected_exception_in_activate_leads_back_to_unconfigured",
        "test_node.py::test_an_unexpected_exception_while_releasing_releases_the_rest",
    ],
    "illegal transition, malformed request": [
        "test_node.py::test_an_illegal_transition_is_refused_and_nothing_changes",
        "test_node.py::test_every_transition_number_is_answered",
        "test_node.py::test_a_transition_may_be_asked_for_by_its_number",
        "test_node.py::test_refused_transitions_do_not_flood_the_log",
        "test_node.py::test_a_malformed_value_is_refused_in_every_state",
        "test_end_to_end.py::test_a_value_of_a_type_that_does_not_exist_is_refused",
    ],
    "unreadable image": [
        "test_node.py::test_a_rejected_image_is_counted_and_the_next_one_detected",
        "test_node.py::test_rejected_images_do_not_flood_the_log",
        "test_end_to_end.py::test_an_unreadable_image_is_counted_and_the_next_one_detected",
    ],
    "inference fails": [
        "test_node.py::test_failures_in_a_row_deactivate_the_node_with_the_reason",
        "test_node.py::test_a_detected_frame_ends_the_count_of_failures",
        "test_runtimes.py::test_what_torch_raises_is_told_in_one_line_and_keeps_nothing_alive",
    ],
    "the GPU is lost to the process": [
        "test_process_end.py::test_a_lost_device_is_told_and_ends_the_process_with_its_own_code",
    ],
    "inference hangs": [
        "test_node.py::test_a_hung_inference_does_not_hold_deactivate",
        "test_worker.py::test_a_hung_frame_is_given_up_and_its_late_result_dropped",
    ],
    "SIGINT, SIGTERM or `shutdown` in any state": [
        "test_end_to_end.py::test_a_signal_ends_the_process_cleanly",
        "test_process_end.py::test_a_signal_ends_the_process_cleanly_while_it_imports",
        "test_end_to_end.py::test_the_transition_shutdown_ends_the_process_cleanly",
        "test_process_end.py::test_a_signal_releases_every_model_and_ends_the_process_whatever_hangs",
        "test_node.py::test_shutdown_from_active_frees_the_model",
    ],
}


def test_every_row_is_pinned() -> None:
    assert [row[0] for row in table(REPOSITORY / "docs" / "architecture.md", "Failures")] == [*PINNED]


@pytest.mark.parametrize("test", sorted({test for tests in PINNED.values() for test in tests}))
def test_a_test_that_is_named_exists(test: str) -> None:
    file, _, name = test.partition("::")
    functions = [
        node.name for node in ast.parse((TESTS / file).read_text()).body if isinstance(node, ast.FunctionDef)
    ]
    assert name in functions
