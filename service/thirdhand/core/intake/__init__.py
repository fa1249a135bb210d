"""Stage 1, intake: check samples of hands and arm, and filter them to a state at the tick."""

from __future__ import annotations

from thirdhand.contract.records import PER_JOINT, Cause, Field

MODES = 4  # modes of the hand filter: rest, steady, reach, change
# states of each mode and axis: position, velocity, acceleration, tremor and its velocity
STATES = 5
# rates of tremor that are distinguished, from slow to fast, and the usual one
TREMOR_RATES = 10
USUAL_RATE = 8
NO_TREMOR = 2  # filters without tremor in the bank of tremor filters
BANK = NO_TREMOR + TREMOR_RATES  # filters of that bank
# agreeing samples that confirm a jump: they show all states but tremor
CONFIRMED_SAMPLES = STATES - 2
# a sample is settled with this number of newer ones: a jump is confirmed
SETTLED_SAMPLES = CONFIRMED_SAMPLES + 1
# retained samples of each hand, among which late ones are inserted: 0.1 s of the fastest tracker
KEPT = 49
STATE = (
    Field("hand_stamps_ns", "int64", (2,)),  # stamp of the newest sample
    Field("hand_ticks", "int64", (2,)),  # tick of the newest sample; -1: none yet
    Field("arm_stamp_ns", "int64"),  # stamp of the arm's newest sample
    Field("arm_tick", "int64"),  # tick of the arm's newest sample; -1: none yet
    Field("arm_still_tick", "int64"),  # tick since which the arm has reported `arm_still_posture`
    # the last two ticks with a plausible state of the arm
    Field("arm_sample_ticks", "int64", (2,)),
    # tick of the first one of the successive samples that jumped
    Field("jump_first_tick", "int64", (2,)),
    # tick of the newest one of the successive samples that jumped
    Field("jump_newest_tick", "int64", (2,)),
    Field("jump_count", "int64", (2,)),  # number of successive samples that jumped
    # stamps of minimum delay: this window, the last one
    Field("quickest_stamps_ns", "int64", (2, 2)),
    # ticks in which the samples with these stamps arrived
    Field("quickest_ticks", "int64", (2, 2)),
    # the clutch counts as pressed before this tick, unless a message follows
    Field("clutch_until_tick", "int64"),
    # the arm counts as led by hand before this tick, unless a message follows
    Field("guided_until_tick", "int64"),
    Field("clock_tick", "int64", (2,)),  # begin of this window; -1: no sample yet
    Field("kept", "int64", (2,)),  # number of retained samples
    Field("kept_newest", "int64", (2,)),  # index of the newest sample in all rings `kept_*`
    Field("kept_stamps_ns", "int64", (2, KEPT)),
    Field("kept_ticks", "int64", (2, KEPT)),  # ticks in which the samples were made
    Field("tremor_rate", "int64", (2,)),  # index of the rate of a hand's tremor
    # stamp of the newest sample in the bank of tremor filters
    Field("bank_stamps_ns", "int64", (2,)),
    Field("bank_ticks", "int64", (2,)),  # tick in which that sample was made
    Field("stale_ticks", "int64", (2,)),  # age from which each hand is stale
    # delay above the minimum, longest of: this window, the last one
    Field("longest_delay_ticks", "int64", (2, 2)),
    Field("corrected_tick", "int64", (2,)),  # tick in which wrong samples were dropped
    # number of samples after which a corrected hand is no longer doubted
    Field("doubted_samples", "int64", (2,)),
    Field("even_samples", "int64", (2,)),  # number of `past_samples` that are evenly spaced
    Field("noise_samples", "int64", (2,)),  # number of samples averaged in the noise variance
    Field("hands", "float64", (2, 3, 3)),  # estimated position, velocity, acceleration; by axis
    # rotation matrices of the newest samples, frame base, row by row
    Field("hand_turns", "float64", (2, 9)),
    Field("hand_velocity_lowpass", "float64", (2, 3)),  # velocity without tremor [m/s]
    # distance of a corrected hand from the place that the dropped samples gave
    Field("hand_doubt_m", "float64", (2,)),
    Field("hand_stillness", "float64", (2,)),  # 0: the hand is on its way; 1: it is still
    Field("mode_means", "float64", (2, MODES, STATES, 3)),
    Field("mode_covariances", "float64", (2, MODES, STATES, STATES)),
    Field("mode_probabilities", "float64", (2, MODES)),
    # tremor of each hand: rate ω [1/s], and variance σ² [m²] of each mode
    Field("tremors", "float64", (2, 1 + MODES)),
    Field("bank_means", "float64", (2, BANK, STATES, 3)),  # of the bank of tremor filters
    Field("bank_covariances", "float64", (2, BANK, STATES, STATES)),
    Field("bank_evidence", "float64", (2, BANK)),  # log likelihood of recent samples
    # mean squared amplitude of the tremor, by rate [m²]
    Field("bank_variances", "float64", (2, TREMOR_RATES)),
    Field("noise_variance", "float64", (2,)),  # variance of the samples on each axis [m²]
    Field("sample_interval_s", "float64", (2,)),  # interval between the two newest samples
    Field("gripper_wish", "float64"),  # newest closure that a tracker wished, 0 to 1; -1: none yet
    Field("past_samples", "float64", (2, 3, 3)),  # the last three positions, newest first [m]
    Field("kept_positions", "float64", (2, KEPT, 3)),
    # `mode_means` after each retained sample
    Field("kept_means", "float64", (2, KEPT, MODES, STATES, 3)),
    # `mode_covariances` after each sample
    Field("kept_covariances", "float64", (2, KEPT, MODES, STATES, STATES)),
    # `mode_probabilities` after each retained sample
    Field("kept_probabilities", "float64", (2, KEPT, MODES)),
    Field("kept_past", "float64", (2, KEPT, 3, 3)),  # `past_samples` after each retained sample
    # noise_variance, noise_samples, even_samples, sample_interval_s
    Field("kept_noise", "float64", (2, KEPT, 4)),
    Field("jumped_to", "float64", (2, 3)),  # position of the newest sample that jumped [m]
    # share of the arm's recent states that contradict the others
    Field("arm_contested", "float64"),
    Field("arm_still_posture", "float64", (PER_JOINT,)),  # posture in which the arm is at rest
    Field("measured", "float64", (PER_JOINT,)),  # joints of the arm's newest sample [rad, m]
    Field("measured_velocities", "float64", (PER_JOINT,)),  # their velocities [rad/s, m/s]
    Field("kept_late", "int32", (2, KEPT)),  # ticks between making and arrival of each sample
    Field("rejected", "uint32", (len(Cause),)),  # rejected samples by cause, since start
    Field("trembles", "uint8", (2,)),  # 1: the hand's tremor is evident
    Field("clock", "uint8", (2,)),  # `codes.ClockTrust`: trust in a tracker's clock
    Field("kept_restarts", "uint8", (2, KEPT)),  # 1: the filter started anew with this sample
)
FRAME = (
    Field("hand_stamp_ns", "int64"),  # stamp of the newest hand sample; 0: none yet
    Field("hands", "float64", (2, 3)),  # estimated positions, left and right, at this tick [m]
    Field("hand_velocities", "float64", (2, 3)),  # estimated velocities [m/s]
    Field("hand_ages", "int32", (2,)),  # ticks since the newest sample; -1: none yet
    Field("stale_ticks", "int32", (2,)),  # age from which each hand is stale
    Field("rejected", "uint32", (len(Cause),)),
)
