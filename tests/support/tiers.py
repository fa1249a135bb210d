"""Which tests are `quick`, which are `research`: by files, or by tests where a file holds both.

`quick` is what a contributor runs before each commit: all but what is listed here as SLOW, RESEARCH
or marked `timed`. What is slow in itself but the only one of its room has a test or two in SMOKE.
`research` is what measures and compares methods at length: it tells about the method, and hardly
ever about a change. Everything else is what a change needs.
"""

from __future__ import annotations

RESEARCH = (
    "cli/test_bench_command.py::test_soak_reports_each_process",
    "cli/test_bench_command.py::test_what_happens_beside_the_loop_is_put_on",
    "cli/test_demo.py::test_a_demo_whose_recording_lacks_ticks_says_so_and_fails",
    "cli/test_view_live.py::test_a_viewer_is_sent_little_more_than_it_has_drawn",
    "core/test_fuzzed_session.py::test_a_session_of_spoilt_bytes_replays_within_every_bound[2]",
    "daemon/test_survival.py::test_the_arm_is_stopped_and_files_are_closed_on[signals1]",
    "daemon/test_survival.py::test_the_arm_is_stopped_and_files_are_closed_on[signals2]",
    "kmp/test_compiled.py::test_operations_give_the_same_bits_as_on_a_cpu_without_vector_units",
    "learning/test_spoilt_staged_tasks.py",
    "viewer/test_drawings.py::test_a_picture_without_a_time_is_of_the_last_moment_at_which_the_arm_followed",
    "viewer/test_lagging_viewers.py",
    "files/test_track_sensitivity.py::test_each_constant_matters_and_none_is_better_halved_or_doubled",
    "sim/test_experiments.py::TestExperiments",
    "sim/test_experiments_run_the_service.py",
    "sim/test_faults.py",
    "sim/test_made_tasks.py",
    "sim/test_partners.py",
    "sim/test_people.py",
    "sim/test_rates.py::test_the_demo_succeeds_at_every_rate_with_every_arm_in_every_engine",
    "files/test_replay.py::test_the_golden_session_replays_bit_for_bit_as_on_a_cpu_without_vector_units",
)
UNCOMPILED = (  # what runs while the others wait for what is compiled, the longest first
    "test_static.py",
    "kmp",
    "test_site.py",
    "test_wheel.py",
    "test_documents.py",
    "test_hand_sample.py",
    "test_architecture.py",
    "settings/test_config.py",
    "test_ci.py",
    "contract",
)
SLOW = (  # the longest first: so they begin first
    "trackers/test_headset.py",
    "trackers/test_mouse_page.py",
    "daemon/test_survival.py",
    "daemon/test_daemon.py",
    "daemon/test_start.py",
    "daemon/test_systemd.py",
    "cli/test_serve_check.py",
    "core/test_warm_up.py",
    "scribe/test_scribe.py",
    "test_static.py",
    "daemon/test_roles.py",
    "cli/test_doctor.py",
    "files/test_replay.py",
    "scribe/test_segments.py",
    "core/test_bounds_from_outside.py",
    "core/test_scenes.py",
    "cli/test_own_task.py",
    "sim/test_bench.py",
    "sim/test_arms.py",
    "sim/test_rates.py",
    "arms/test_first_cell.py",
    "settings/test_odd_urdfs.py",
    "sim/test_engines.py",
    "process/test_interrupt.py",
    "daemon/test_fuzzed_daemon.py",
    "cli/test_view_live.py",
    "daemon/test_network.py",
    "core/test_fuzzed_session.py",
    "cli/test_command_line.py",
    "client/test_client_settings.py",
    "cli/test_learn_command.py",
    "daemon/test_skill_worker.py",
    "cli/test_report_command.py",
    "test_examples.py",
    "test_readme.py",
    "kmp/test_distribution.py",
    "kmp/test_compiled.py",
    "test_site.py",
    "test_wheel.py",
    "core/test_separation.py::test_the_arm_stops_for_a_hand_in_its_way",
    "core/test_separation.py::test_motion_that_leaves_a_hand_is_not_slowed",
    "core/test_pose.py::test_the_arm_turns_its_tool_all_the_way_where_it_is_told_to",
    "core/test_setpoint.py::test_targets_that_alternate_or_tremble_make_no_setpoint_run_away",
    "core/test_setpoint.py::test_an_axis_that_wild_ones_starve_comes_back",
    "core/test_arm_sources.py::test_no_stranger_makes_a_command_jump",
    "core/test_plausibility.py::test_any_samples_are_taken_or_counted_and_leave_a_state_that_can_be_calculated_with",
    "daemon/test_way_out.py",
    "learning/test_gate.py",
    "kmp/test_low_rank.py",
    "kmp/test_tutorial.py",
    "viewer/test_sinks.py",
    "viewer/test_drawings.py::test_of_several_files_the_last_is_pictured_and_that_is_said",
    "report/test_lerobot.py",
    "files/test_damage.py",
    "daemon/test_requests.py",
    "test_hand_sample.py",
    "trackers/test_calibration.py",
    "trackers/test_taking.py::test_a_demonstration_is_recorded_shown_trimmed_and_deleted",
)
SMOKE = (
    "cli/test_learn_command.py::test_where_a_skill_is_to_go_is_looked_at_before_anything_is_read",
    "daemon/test_daemon.py::test_a_session_from_start_to_end",
    "scribe/test_scribe.py::test_what_is_told_is_recorded_and_drawn",
    "sim/test_bench.py::test_a_tool_that_goes_as_taught_does_the_task",
    "sim/test_engines.py::test_the_arm_follows_moving_commands_within_a_millimetre",
    "files/test_replay.py::test_a_recording_of_checksums_becomes_one_of_frames_bit_for_bit",
    "test_static.py::test_static_checks_find_nothing[lint]",
    "test_static.py::test_static_checks_find_nothing[format]",
)


def is_among(test: str, named: tuple[str, ...]) -> bool:
    """Whether a test (`folder/file.py::name[parameters]`) is one of these, or in one of these."""
    return any(test == one or test.startswith((f"{one}::", f"{one}[", f"{one}/")) for one in named)


def markers(test: str, *, timed: bool) -> list[str]:
    """The markers that a test gets."""
    if is_among(test, RESEARCH):
        return ["research"]
    if timed or (is_among(test, SLOW) and not is_among(test, SMOKE)):
        return []
    return ["quick"]


def begins(test: str) -> tuple[int, int]:
    """The place of a test's file in the order in which files are begun: the longest first."""
    file, slow = test.split("::", maxsplit=1)[0], [one.split("::", maxsplit=1)[0] for one in SLOW]
    early = [is_among(test, (one,)) for one in UNCOMPILED]
    return (*early, True).index(True), (*slow, file).index(file)
