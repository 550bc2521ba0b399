"""Every row of the table of failures in docs/architecture.md is pinned by tests."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from support.colcon_workspace import REPOSITORY
from support.pages import table

TESTS = Path(__file__).parent
PINNED = {
    "bad value, unknown parameter or contradiction at configure; weights outside `weights_dirs`; "
    "a QoS override that does not fit its topic; two topics remapped to one name": [
        "test_image_topic.py::test_configure_refuses_topics_that_are_remapped_to_one",
        "test_parameter_files.py::test_every_mistake_in_a_parameter_file_is_named_and_can_be_corrected",
        "test_parameter_overrides.py::test_a_bad_override_fails_configure_until_it_is_corrected",
        "test_parameter_overrides.py::test_an_unknown_override_may_be_deleted",
        "test_qos_overrides.py::test_configure_refuses_a_wrong_override_until_the_next_start",
        "test_allowed_folders.py::test_configure_refuses_weights_from_outside",
        "test_allowed_folders.py::test_invalid_folders_fail_configure_until_the_process_is_restarted",
    ],
    "a parameter file that does not exist, cannot be parsed or is too large": [
        "test_parameter_files.py::test_parameter_files_that_cannot_be_read_are_reported_at_the_start",
        "test_parameter_file.py::test_a_file_that_is_too_much_is_refused",
        "test_start_arguments.py::test_bad_files_are_left_out_and_the_others_kept",
    ],
    "weights missing, corrupt, hostile or of another kind; device absent; unknown class, at activate": [
        "test_process_parameters.py::test_missing_weights_are_named_with_the_remedy_and_may_be_given_then",
        "test_weights_in_service.py::test_a_bad_file_is_refused_by_activate_and_by_a_swap",
        "test_allowed_folders.py::test_a_running_node_refuses_weights_from_outside",
        "test_parameter_files.py::test_a_parameter_file_is_taken_as_it_is_meant",
        "test_activation.py::test_activate_that_cannot_load_says_why_and_stays_inactive",
        "test_activation.py::test_activate_refuses_a_class_that_the_model_does_not_have",
    ],
    "the same in a reload": [
        "test_weights_in_service.py::test_a_bad_file_is_refused_by_activate_and_by_a_swap",
        "test_weights_in_service.py::test_a_swap_to_a_model_without_a_filtered_class_is_explained",
        "test_allowed_folders.py::test_a_running_node_refuses_weights_from_outside",
        "test_reload.py::test_a_refused_reload_leaves_model_and_value_alone",
    ],
    "unexpected exception in a transition": [
        "test_transitions.py::test_an_unexpected_exception_in_activate_leads_back_to_unconfigured",
        "test_transitions.py::test_an_unexpected_exception_while_releasing_releases_the_rest",
    ],
    "illegal transition, malformed or oversized request": [
        "test_parameter_requests.py::test_a_request_with_too_many_parameters_is_refused_as_a_whole",
        "test_parameter_requests.py::test_a_request_about_too_many_names_is_answered_with_nothing",
        "test_transitions.py::test_an_illegal_transition_is_refused_and_nothing_changes",
        "test_transitions.py::test_every_transition_number_is_answered",
        "test_transitions.py::test_a_transition_may_be_asked_for_by_its_number",
        "test_transitions.py::test_refused_transitions_do_not_flood_the_log",
        "test_set_parameters.py::test_a_malformed_value_is_refused_in_every_state",
        "test_process_parameters.py::test_a_value_of_a_type_that_does_not_exist_is_refused",
    ],
    "a reload while another one waits": [
        "test_parameter_requests.py::test_of_many_concurrent_reloads_the_first_and_the_last_are_carried_out",
    ],
    "a change that fails when it takes effect": [
        "test_parameter_requests.py::test_a_change_that_cannot_take_effect_leaves_nothing_behind",
    ],
    "the middleware refuses the image subscription": [
        "test_image_topic.py::test_a_subscription_that_the_middleware_refuses_is_an_error_until_it_succeeds",
    ],
    "unreadable image": [
        "test_frames.py::test_a_rejected_image_is_counted_and_the_next_one_detected",
        "test_frames.py::test_rejected_images_do_not_flood_the_log",
        "test_end_to_end.py::test_an_unreadable_image_is_counted_and_the_next_one_detected",
        "test_cameras.py::test_a_camera_that_sends_garbage_is_told_apart_from_the_others",
    ],
    "cameras whose topics are remapped to one name, or a new camera whose settings do not fit the model": [
        "test_cameras.py::test_cameras_whose_topics_are_remapped_to_one_name_are_refused",
        "test_cameras.py::test_an_added_camera_that_cannot_start_changes_nothing",
    ],
    "a camera is removed while its frame hangs, at whatever step": [
        "test_kept_network.py::test_detections_are_right_while_an_abandoned_thread_uses_its_network",
        "test_kept_network.py::test_services_answer_while_a_removed_camera_hangs",
        "test_kept_network.py::"
        "test_a_network_that_cannot_be_prepared_again_deactivates_the_node_with_the_reason",
        "test_cameras.py::test_a_camera_whose_frame_hangs_can_be_removed_and_the_others_go_on",
    ],
    "depth image or `camera_info` missing, late, unreadable or of another size": [
        "test_depth.py::test_an_image_without_depth_is_detected_and_counted_with_the_reason",
        "test_depth.py::test_images_of_another_size_than_depth_are_counted_and_explained",
        "test_depth.py::test_hostile_messages_are_rejected_counted_and_explained_and_the_next_is_used",
    ],
    "inference fails": [
        "test_frames.py::test_failures_in_a_row_deactivate_the_node_with_the_reason",
        "test_frames.py::test_a_detected_frame_ends_the_count_of_failures",
        "test_cameras.py::test_failures_of_one_camera_do_not_end_the_detection_of_another",
        "test_runtimes.py::test_an_error_of_torch_is_one_line_and_keeps_nothing_alive",
    ],
    "the GPU is lost to the process": [
        "test_process_end.py::test_a_lost_device_is_reported_and_ends_the_process_with_its_own_code",
    ],
    "too little free in `/dev/shm` when the process starts": [
        "test_shared_memory.py::test_a_process_with_too_little_says_so_and_works",
        "test_shared_memory.py::test_a_process_that_the_tracer_ends_has_said_why",
    ],
    "a frame hangs, at whatever step": [
        "test_slow_steps.py::test_while_a_frame_hangs_services_answer_and_deactivate_proceeds",
        "test_frames.py::test_a_hung_inference_does_not_block_deactivate",
        "test_worker.py::test_a_hung_frame_is_abandoned_and_its_late_result_dropped",
    ],
    "more than three inference threads hang": [
        "test_process_end.py::"
        "test_too_many_abandoned_threads_are_reported_and_end_the_process_with_their_own_code",
        "test_worker.py::test_a_hung_frame_is_abandoned_and_its_late_result_dropped",
    ],
    "the standard output or error stream is closed, full, or without a reader": [
        "test_standard_streams.py::test_a_node_does_its_work_with_closed_streams",
        "test_standard_streams.py::test_a_node_goes_on_when_nobody_reads_its_log",
    ],
    "too few threads can be started": [
        "test_process_start.py::test_too_few_threads_are_said_in_one_line",
    ],
    "SIGINT, SIGTERM, SIGHUP or `shutdown` in any state": [
        "test_shutdown.py::test_a_signal_ends_the_process_cleanly",
        "test_process_end.py::test_a_signal_ends_the_process_cleanly_while_it_imports",
        "test_shutdown.py::test_the_transition_shutdown_is_answered_and_ends_the_process_cleanly",
        "test_process_end.py::test_a_signal_releases_every_model_and_ends_the_process_whatever_hangs",
        "test_transitions.py::test_shutdown_from_active_frees_the_model",
        "test_finalized_period.py::test_it_lasts_for_its_duration_from_the_first_look",
    ],
}


def test_every_row_is_pinned() -> None:
    assert [row[0] for row in table(REPOSITORY / "docs" / "architecture.md", "Failures")] == [*PINNED]


@pytest.mark.parametrize("test", sorted({test for tests in PINNED.values() for test in tests}))
def test_a_test_that_is_named_exists(test: str) -> None:
    file, _, name = test.partition("::")
    (path,) = TESTS.rglob(file)
    functions = [node.name for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)]
    assert name in functions
