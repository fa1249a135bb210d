"""Stage 1, intake: samples of hands and arm, checked and filtered to a state at the tick."""

from __future__ import annotations

from service.contract.records import PER_JOINT, SOURCES, Cause, Field

MODES = 3  # of the hand estimator's motion models
STATES = 5  # of each, by axis: position, velocity, acceleration, tremor and its velocity
KEPT = 49  # samples of each hand, among which late ones are filtered in: 0.1 s of the fastest tracker
STATE = (
    Field("hand_stamps_ns", "int64", (2,)),
    Field("hand_ticks", "int64", (2,)),  # tick of the newest sample; -1: none yet
    Field("arm_stamp_ns", "int64"),
    Field("arm_tick", "int64"),
    Field("arm_still_tick", "int64"),  # since which the arm has reported `arm_still_posture`
    Field("sample_ticks", "int64", (len(SOURCES), 2)),  # the last two at which a sample could have been right
    Field("jump_first_tick", "int64", (2,)),  # of a hand's samples that jumped, in a row
    Field("jump_newest_tick", "int64", (2,)),
    Field("jump_count", "int64", (2,)),
    Field("quickest_stamps_ns", "int64", (2, 2)),  # of the samples that came soonest, this second and the last
    Field("quickest_ticks", "int64", (2, 2)),
    Field("clock_tick", "int64", (2,)),  # when this second began; -1: not yet
    Field("kept", "int64", (2,)),  # how many samples are kept
    Field("kept_newest", "int64", (2,)),  # where in the rings that follow the newest one is
    Field("kept_stamps_ns", "int64", (2, KEPT)),
    Field("kept_ticks", "int64", (2, KEPT)),  # as of which they were taken
    Field("other_tick", "int64", (2,)),  # of the newest sample that jumped, whatever came of it
    Field("other_after_ns", "int64", (2,)),  # stamp of the sample that was the newest one then
    Field("even_samples", "int64", (2,)),  # how many of the past samples are evenly spaced
    Field("noise_samples", "int64", (2,)),  # averaged in the noise variance
    Field("hands", "float64", (2, 3, 3)),  # estimated position, velocity, acceleration; by axis
    Field("hand_turns", "float64", (2, 9)),  # of the newest samples: rotation matrices in frame base, row by row
    Field("hand_velocity_lowpass", "float64", (2, 3)),  # without tremor [m/s]
    Field("hand_stillness", "float64", (2,)),  # 0: on its way, 1: still
    Field("mode_means", "float64", (2, MODES, STATES, 3)),
    Field("mode_covariances", "float64", (2, MODES, STATES, STATES)),
    Field("mode_probabilities", "float64", (2, MODES)),
    Field("noise_variance", "float64", (2,)),  # of each hand's samples, each axis [m²]
    Field("sample_interval_s", "float64", (2,)),
    Field("response_s", "float64"),  # in which the estimator follows a change of motion
    Field("past_samples", "float64", (2, 3, 3)),  # newest first [m]
    Field("kept_positions", "float64", (2, KEPT, 3)),
    Field("kept_means", "float64", (2, KEPT, MODES, STATES, 3)),  # the filter when each was taken, in all its parts
    Field("kept_covariances", "float64", (2, KEPT, MODES, STATES, STATES)),
    Field("kept_probabilities", "float64", (2, KEPT, MODES)),
    Field("kept_past", "float64", (2, KEPT, 3, 3)),
    Field("kept_noise", "float64", (2, KEPT, 4)),  # variance, samples averaged in it, evenly spaced ones, interval
    Field("jumped_to", "float64", (2, 3)),  # where the newest sample that jumped was [m]
    Field("other_offset", "float64", (2, 3)),  # from where the hand was then to where that sample is [m]
    Field("contested", "float64", (len(SOURCES),)),  # the share of the last second's samples that contradict the others
    Field("arm_still_posture", "float64", (PER_JOINT,)),
    Field("measured", "float64", (PER_JOINT,)),
    Field("measured_velocities", "float64", (PER_JOINT,)),
    Field("kept_late", "int32", (2, KEPT)),  # ticks after which they came
    Field("rejected", "uint32", (len(Cause),)),
    Field("clock", "uint8", (2,)),  # whether a tracker's clock is believed
    Field("kept_restarts", "uint8", (2, KEPT)),  # with which the filter began anew
    Field("other_returns", "uint8", (2,)),  # whether that one, and so those in its row, are of another track
    Field("jump_is_swap", "uint8", (2,)),  # the hand jumped to where the other one had been
)
FRAME = (
    Field("hand_stamp_ns", "int64"),  # of the newest sample in it; 0: none yet
    Field("hands", "float64", (2, 3)),  # left and right, filtered, at this tick [m]
    Field("hand_velocities", "float64", (2, 3)),
    Field("hand_ages", "int32", (2,)),  # ticks since the newest sample; -1: none yet
    Field("rejected", "uint32", (len(Cause),)),
)
