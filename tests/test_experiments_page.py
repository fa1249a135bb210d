"""Each number in docs/experiments.md is one of the results in recordings/experiments, to the digits
that are printed, or named here as a setting or a reference.
"""

from __future__ import annotations

import pytest

from sim.experiments.moving_hands import MOST_LATE_S, UNSEEN_S
from support.told_numbers import NUMBER, WORDS, AtMost, Source, blocks, of, result, wrong


def percent(path: str) -> float:
    """A share as a percentage."""
    return of(path, 100.0)


def at_six(method: str) -> float:
    """The error [%] of a method with six inputs."""
    rows = result("promp")["dimensions"]
    return 100 * float(next(r["error"] for r in rows if (r["method"], r["inputs"]) == (method, 6)))


def successes(method: str) -> float:
    return of(f"statistics/methods/{method}/successes")


def people(method: str, measure: str = "success", which: str = "mean", scale: float = 100) -> float:
    return of(f"people/methods/{method}/{measure}/{which}", scale)


def follows(measure: str, group: str) -> tuple[float, float]:
    """What the service does, and as a share of what the tuned One-Euro filter does."""
    ours, other = (of(f"motion/by_follower/{name}/{group}/{measure}") for name in ("ours", "chase, One-Euro 4 Hz, 40"))
    return ours, ours / other


def paper(variant: str) -> list[Source]:
    """Off by (median, 95 %), scenes of all with one of the paper's numbers."""
    one = f"hands/beside_the_paper/{variant}"
    within = of(f"{one}/within_3_cm_at_all_events_percent")
    return [of(f"{one}/error_median_mm"), of(f"{one}/error_p95_mm"), 40 * within / 100, "40"]


def broken(kind: str) -> list[Source]:
    """Successes, and held if any, of a kind of break of the rules."""
    found: list[Source] = []
    for method in ("ours", "look_up", "gaussian_process", "as_paper"):
        one = f"people/breaking/{method}/{kind}"
        found += [of(f"{one}/successes"), *([held] if (held := of(f"{one}/held")) else [])]
    return found


def partners(group: str, task: str, told: str = "") -> list[Source]:
    """A row of a table of `partners`: ours, unless all is refused; what is refused; and rivals."""
    found = result("partners")[group][task]["methods"]
    ours, takes = found["service" + told], found["mean" + told]["takes"]
    row: list[Source] = [word for word in NUMBER.findall(task) if word in WORDS]
    if ours["takes"]:
        row += [ours["rms_mm"], ours["shifted_rms_mm"], 100 * ours["coverage"][5], 100 * ours["held"]]
    rivals = ("linear", "same elapsed time", "Gaussian process", "with 2 s of memory", "HMM over demonstrations")
    return [*row, ours["refuses"], takes, *(found[name + told]["rms_mm"] for name in rivals)]


def most(path: str, scale: float = 1.0, *, least: bool = False) -> float:
    """The largest or least of the numbers in a dictionary or list."""
    name, *keys = path.split("/")
    value = result(name)
    for key in keys:
        value = value[key]
    numbers = value.values() if isinstance(value, dict) else value
    return scale * float((min if least else max)(numbers))


def learned_misses() -> list[float]:
    return [of(f"hands/reproduction/{event}_mm") for event in ("handover", "grasp", "carry")]


def taught_misses() -> float:
    return max(of(f"hands/adaptation/{event}_mm") for event in ("handover", "grasp", "carry"))


def orientation() -> float:
    return max(float(one["from_the_eyes_in_the_last_second_deg"]) for one in result("orientation")["scenes"].values())


def reached() -> float:
    """The largest miss of a desired point [mm], of both sets and methods."""
    sets = [result("promp")[f"{name}_summary"][who] for name in ("model", "recorded") for who in ("kmp", "promp")]
    return 10 * max(float(one["largest_miss_cm"]) for one in sets)


def elsewhere(name: str) -> list[Source]:
    """A row of the table of distances off the mean [cm]."""
    keys = ("mean_rms", "mean_largest", "largest")
    return [of(f"promp/{name}_summary/{who}/{key}_deviation_elsewhere_cm") for who in ("kmp", "promp") for key in keys]


def most_missed(who: str, *, scale: float = 1.0) -> float:
    """The largest miss of a point [cm] by a method of Table I, times a scale."""
    found = [result("table")[which][who] for which in ("modelled", "recorded")]
    return scale * max(float(one[f"largest_miss_of_{kind}_cm"]) for one in found for kind in ("start", "via", "end"))


def better(name: str, who: str) -> list[Source]:
    """How many of how many adaptations a method changes less elsewhere."""
    kmp, all_of_them = (
        of(f"promp/{name}_summary/{key}") for key in ("kmp_leaves_the_rest_better_alone", "adaptations")
    )
    return [kmp if who == "kmp" else all_of_them - kmp, all_of_them]


def letters(name: str) -> float:
    return len(result("promp")[name])


# By the beginning of each paragraph or row: where its numbers are from, in order.
SOURCES: dict[str, list[Source]] = {
    "| `letters`, `promp`": [AtMost(reached()), *better("model", "kmp"), *better("recorded", "promp")],
    "| `table`": [
        AtMost(most_missed("kmp", scale=10)),
        most_missed("dmp"),
        most_missed("gmm"),
    ],
    "| `promp-dimensions`": [
        "six",
        at_six("KMP, at 200 samples"),
        of("promp/dimensions/0/functions"),
        at_six("ProMP, at 200 samples"),
        at_six("kernel ridge, 200 samples"),
        at_six("GMM"),
    ],
    "| `runs`": [
        of("runs/runs_that_fell"),
        of("runs/runs"),
        of("runs/cost_fall_percent/least"),
        of("runs/cost_fall_percent/largest"),
    ],
    **{
        f"| {title}, {which}": [
            *(of(f"table/{which}/{who}/largest_miss_of_{one}_cm") for one in ("start", "via", "end")),
            of(f"table/{which}/{who}/mean_rms_deviation_elsewhere_cm"),
        ]
        for which in ("modelled", "recorded")
        for who, title in (("kmp", "KMP"), ("promp", "ProMP"), ("dmp", "DMP"), ("gmm", "GMM"))
    },
    "`runs`": [
        "3",
        *("ten", "10"),
        of("runs/cost_fall_percent/mean"),
        of("runs/cost_fall_percent/least"),
        of("runs/cost_fall_percent/largest"),
        AtMost(of("runs/largest_miss_of_the_via_point_cm", 10)),
    ],
    "![Cost after": ["ten"],
    "| `correlation`": [of("correlation/cost_fall_percent/mean"), of("correlation/cost_beside_c_percent/learned/mean")],
    "| `hands`": [AtMost(taught_misses())],
    "| `statistics`": [
        successes("ours"),
        of("statistics/scenes"),
        *map(successes, ("gaussian_process_5", "look_up", "paper", "promp")),
    ],
    "| `people`": [
        people("ours"),
        people("ours", "success_on_the_way"),
        people("look_up"),
        people("gaussian_process"),
    ],
    "| `partners`": [
        partners("made", "six", ", told")[1],
        "six",
        *(partners("made", kind, ", told")[0] for kind in ("cyclic", "heading")),
        *(partners("made", kind, ", told")[-2] for kind in ("six", "cyclic", "heading")),
    ],
    "| `motion`": [
        follows("error_rms_mm", "clean")[0],
        follows("jerk_ratio", "clean")[1],
        1 / follows("error_rms_mm", "clean")[1],
    ],
    "| `separation`": [
        of("separation/scenes"),
        of("separation/thrust/above_after_reaction"),
        of("separation/scenes"),
    ],
    "| `phase`": [of("phase/ours/back_against_forth_rms_mm"), of("phase/promp/back_against_forth_rms_mm")],
    "| `orientation`": [AtMost(orientation()), len(result("orientation")["scenes"])],
    "[`letters`]": [
        *("1", "2", "five"),
        letters("model"),
        letters("recorded"),
        "three",
        AtMost(reached()),
        *better("model", "kmp"),
        *better("recorded", "promp"),
    ],
    "## Three more": ["three"],
    "![Eighteen": [letters("model") + letters("recorded"), "three"],
    "![Hands and tool": ["five"],
    "![Success and errors": [of("statistics/scenes"), len(result("statistics")["methods"])],
    "![Success, path": [len(result("people")["methods"]) - 1],  # without the teacher
    "| modelled": elsewhere("model"),
    "| recorded": elsewhere("recorded"),
    "The paper's Table I": [
        *("five", "six"),
        of("promp/dimensions/30/functions"),
        len({one["method"] for one in result("promp")["dimensions"] if one["error"] is None}),
        *("six", "1"),
    ],
    "Errors are": [
        of("promp/dimensions/28/functions"),
        "six",
        at_six("ProMP, at 200 samples"),
        at_six("kernel ridge, 200 samples"),
        "three",
        of("promp/dimensions/29/functions"),
        at_six("ProMP, 3 per input"),
        at_six("KMP, at 200 samples"),
        at_six("KMP"),
        of("promp/dimensions/24/functions"),
        of("promp/dimensions/26/functions"),
        at_six("GMM"),
    ],
    "`correlation`": [
        "3",
        AtMost(of("correlation/largest_miss_of_a_via_point_cm", 10)),
        of("correlation/cost_fall_percent/mean"),
        len(result("correlation")["letters"]),
        of("correlation/via_points_each"),
        "95",
        of("correlation/cost_fall_percent/low"),
        of("correlation/cost_fall_percent/high"),
        *(of(f"correlation/cost_beside_c_percent/learned/{key}") for key in ("mean", "low", "high", "p")),
        of("correlation/cost_beside_c_percent/random/mean", -1),
        *(of(f"correlation/cost_beside_c_percent/begun_at_c/{key}", -1) for key in ("mean", "high", "low")),
        of("correlation/cost_beside_c_percent/begun_at_c/p"),
        of("correlation/correlations_whose_sign_changed_percent"),
    ],
    "`hands`": [
        *("4", "5"),
        min(learned_misses()),
        max(learned_misses()),
        of("hands/reproduction/periods_skipped_by_bench"),
        most("hands/moved_cm", least=True),
        most("hands/moved_cm"),
        AtMost(taught_misses()),
        of("hands/adaptation/periods_skipped_by_bench"),
        of("hands/evidence_is_periods_skipped_at_most"),
    ],
    "Some numbers of a skill": [
        *("10", "40", "8"),
        of("hands/beside_the_paper/ours/error_median_mm"),
        "95",
        of("hands/beside_the_paper/ours/error_p95_mm"),
        *("three", "3"),
        paper("ours")[2],
    ],
    "| | here": ["95"],
    "| points a place": ["13", "3", "1", *paper("one point a place")],
    "| ell": ["5", "0.5", *paper("ell 0.5"), "half"],
    "| added deviation": ["1", "0", *paper("no spread"), "five"],
    "| all three": ["three", *paper("all three: the paper's")],
    "`statistics`": [
        *("15", "0.5", "2", "8"),
        successes("ours"),
        of("statistics/scenes"),
        *map(successes, ("gaussian_process_5", "none", "look_up", "gaussian_process", "paper", "promp", "gmr")),
    ],
    "`people` asks": [
        of("people/people"),
        *("5", "10"),
        of("people/success_is/within_mm"),
        of("people/success_is/for_s"),
        "three",
        people("ours"),
        of("people/people") * of("people/scenes_of_each"),
        "95",
        people("ours", which="low"),
        people("ours", which="high"),
        *map(people, ("as_paper", "none", "gaussian_process", "look_up")),
        people("look_up", which="low"),
        people("look_up", which="high"),
        *(people(method, "path_rms_mm", scale=1) for method in ("ours", "gaussian_process", "look_up")),
        of("people/falsely_followed_is_farther_from_the_teacher_than_m", 100),
        people("ours", "falsely_followed"),
        people("look_up", "falsely_followed"),
        "5",
        *(people("ours", "success_on_the_way", which) for which in ("mean", "low", "high")),
        people("gaussian_process", "success_on_the_way"),
        people("look_up", "too_near"),
        people("ours", "falsely_held"),
        "0.3",
        "95",
        people("ours", "inside_95"),
        "50",
        people("ours", "inside_50"),
        of("people/methods/ours/error_rms_mm"),
        of("people/methods/ours/predicted_rms_mm"),
    ],
    "| of 40": [of("people/breaking_scenes_of_each")],
    "| hands stop 24 mm off": ["24", *broken("hands stop 24 mm off")],
    "| hands start 15 cm": ["15", *broken("hands start 15 cm elsewhere")],
    "| paths bowed": ["10", *broken("paths bowed by 10 cm")],
    "| right hand": ["2", *broken("right hand 2 s early")],
    "| iron 10 cm": ["10", *broken("iron 10 cm elsewhere")],
    "`partners` asks": [*("95", "2")],
    "With `--data": ["3"],
    "Made tasks": [
        of("partners/demonstrators"),
        of("partners/tested_people"),
        *("0.05", "0.35", "5", "10", "three", "six", "twelve", "2"),
    ],
    **{f"| {task} |": partners("recorded", task) for task in result("partners")["recorded"]},
    "| give, told |": partners("recorded", "give", ", told"),
    **{f"| `{kind}` |": partners("made", kind, ", told") for kind in result("partners")["made"]},
    "`motion`": [
        "100",
        follows("error_rms_mm", "clean")[0],
        follows("lag_ms", "clean")[0],
        follows("error_rms_mm", "clean")[1],
        follows("jerk_ratio", "clean")[1],
        "30",
        follows("error_rms_mm", "recorded")[0],
        follows("lag_ms", "recorded")[0],
        follows("error_rms_mm", "recorded")[1],
        follows("jerk_ratio", "recorded")[1],
    ],
    "`--hands DIR`": [sum(result("motion-of-others")["takes"].values())],
    **{
        f"| `{one}` |": [
            *one.split()[1:],
            *(
                of(f"motion-of-others/by_person/{group}/{one}/{who}")
                for group in ("clean", "recorded")
                for who in ("ours", "chase")
            ),
        ]
        for one in result("motion-of-others")["takes"]
    },
    "All together, ours errs": [
        *(of(f"motion-of-others/all/{group}/{what}") for group in ("clean", "recorded") for what in ("ours", "ratio")),
        1000 * MOST_LATE_S,
        *(of(f"motion-of-others/harder/late/{what}") for what in ("ours", "times_clean")),
        *(1000 * share for share in UNSEEN_S),
        of("motion-of-others/harder/unseen/ours"),
    ],
    "After a sudden stop": [
        *(of(f"motion/by_follower/ours/sudden stops/overshoot_{key}_mm") for key in ("mean", "worst")),
        "30",
        *(
            of(f"motion/by_follower/{who}/sudden stops, 30 Hz, 2 mm/overshoot_{key}_mm")
            for who in ("ours", "chase, One-Euro 4 Hz, 40")
            for key in ("mean", "worst")
        ),
        of("motion/by_follower/ours/minimum jerk/lag_ms"),
    ],
    "How the joints move": [
        *("4", "13"),
        *(percent(f"motion/joint_speeds_in_the_scene/{who}/ripple") for who in ("ours", "chase")),
    ],
    "`separation`": [
        of("separation/scenes"),
        of("separation/rate_hz"),
        of("separation/scenes"),
        of("separation/thrust/fastest_hand"),
    ],
    "All distances": [
        of("separation/shown/random/scenes"),
        *(of(f"separation/shown/{kind}/closest_of_capsules_mm") for kind in ("random", "thrust")),
        of("separation/shown/random/closest_of_shapes_mm"),
        of("separation/scenes"),
        of("separation/random/closest_of_shapes_mm/least"),
    ],
    "In 93 of these": [
        of("separation/scenes") - of("separation/thrust/above_after_reaction"),
        of("separation/thrust/above_after_reaction"),
        of("separation/thrust/excess_after_reaction"),
        of("separation/thrust/excess_lasts_s"),
        of("separation/thrust/overlaps"),
        of("separation/thrust/closest_of_shapes_mm/least", -1),
        of("separation/thrust/pushed_mm"),
        of("separation/scenes"),
    ],
    "* [`phase`]": [
        of("phase/ours/back_against_forth_rms_mm"),
        of("phase/promp/back_against_forth_rms_mm"),
        of("phase/hand_from_its_place_in_the_pause_mm", 0.1),
        of("phase/ours/goes_on_in_the_pause_mm"),
        of("phase/tremor_mm"),
        of("phase/tremor_in_space_rms_mm"),
        of("phase/ours/tremor_of_the_tool_in_the_pause_rms_mm"),
        of("phase/ours/tremor_beside_its_drift_rms_mm"),
        of("phase/promp/tremor_of_the_tool_in_the_pause_rms_mm"),
        of("phase/promp/tremor_beside_its_drift_rms_mm"),
    ],
    "* [`demonstrations`]": [
        of("demonstrations/by_count/1/success_percent") / 100 * of("demonstrations/scenes"),
        of("demonstrations/scenes"),
        of("demonstrations/by_count/10/reproduction_rms_mm"),
        "ten",
        of("demonstrations/by_count/1/reproduction_rms_mm"),
        "five",
        of("demonstrations/by_count/5/reproduction_rms_mm"),
        of("demonstrations/floor_mm"),
    ],
    "* [`orientation`]": [
        "3",
        AtMost(orientation()),
        len(result("orientation")["scenes"]),
        sum(name != "nominal" for name in result("orientation")["scenes"]),
    ],
}


README: dict[str, list[Source]] = {
    "With modelled people": [people("ours"), people("ours", "success_on_the_way"), people("look_up")]
}


@pytest.mark.parametrize(("page", "sources"), [("docs/experiments.md", SOURCES), ("README.md", README)])
def test_each_number_is_a_result_to_the_digits_printed_or_a_setting_named_here(
    page: str, sources: dict[str, list[Source]]
) -> None:
    found, used = [], []
    for block in blocks(page):
        keys = [key for key in sources if block.startswith(key)]
        used += keys
        if keys or page.startswith("docs"):
            found += wrong(block, [one for key in keys for one in sources[key]])
    assert found == []
    assert sorted(used) == sorted(sources), "each of the paragraphs is there once"


def test_what_is_no_evidence_by_its_own_rule_is_called_so() -> None:
    runs = {name: result("hands")[name] for name in ("reproduction", "nominal", "adaptation")}
    limit = result("hands")["evidence_is_periods_skipped_at_most"]
    assert limit == 25
    for one in runs.values():
        assert one["evidence"] == (one["periods_skipped_by_bench"] <= limit)
    (row,) = (block for block in blocks("docs/experiments.md") if block.startswith("| `hands`"))
    (told_of,) = (block for block in blocks("docs/experiments.md") if block.startswith("`hands`"))
    assert ("no evidence" in row) != runs["adaptation"]["evidence"]
    sentences = {"reproduction": "As learned", "adaptation": "Taught new ones"}
    for name, begins in sentences.items():
        sentence = told_of[told_of.index(begins) :].partition(". ")[0]
        assert ("no evidence" in sentence) != runs[name]["evidence"], sentence


def test_a_number_that_is_none_of_the_results_is_found() -> None:
    assert wrong("8.9 mm, at 0.18 times, 15 625 of two", [8.926, 0.1795, 15625, 2]) == []
    assert wrong("within 0.3, -2 to 11", [AtMost(0.2929), -1.95, 10.523]) == []
    assert len(wrong("a fifth, 1.15, 60, within 0.2", [0.1795, 1.1443, 58.0, AtMost(0.2929)])) == 4
    assert len(wrong("one of 9", [])) == len(wrong("none", [9.0])) == 1
