"""The experiment `sensitivity`: the service reads its numbers from memory, and what is made of the
figures.
"""

from __future__ import annotations

import ast
import json
import math
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sim.experiments import sensitivity
from sim.experiments.catalogue import EXPERIMENTS
from support.paths import ROOT

# Gains of the tracker and transitions of the hand filter: numbers of two stages, one of them in an
# array, all read by plain Python, which need not be compiled here.
PROGRAM = """
import json, sys
from sim.experiments import sensitivity
known = sensitivity.begin()
from service.core.intake.motion_model import models
from service.core.setpoint.tracker import gains_for
from service.settings.config import Settings

def computed():
    sensitivity.forget()
    return gains_for(Settings()).tolist(), models(0.002, 3)["transition"].tolist()

out = {"tuned": computed()}
out["marked"] = [key for key, one in known.items() if sensitivity.marks[one.at]]
for key, factor in (("setpoint.TRACKER_RATE_SHARE", 0.5), ("intake.MODE_VELOCITY_REVERSIONS_PER_S2", 2.0)):
    one = known[key]
    sensitivity.values[one.at : one.at + one.size] = one.changed(factor)
    out[key] = computed()
print(json.dumps(out))
"""


def test_a_number_in_memory_changes_what_reads_it_and_nothing_else() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    (gains, motion), (other, same), (_, changed) = (
        found["tuned"],
        found["setpoint.TRACKER_RATE_SHARE"],
        found["intake.MODE_VELOCITY_REVERSIONS_PER_S2"],
    )
    assert gains != other
    assert motion == same != changed
    assert {"setpoint.TRACKER_RATE_SHARE", "intake.TREMOR_DAMPING"} <= set(found["marked"])
    assert "arm.DAMPING_M2" not in found["marked"]


def test_the_service_is_refused_once_it_has_been_imported() -> None:
    program = "import service.core.stops, service.core.intake.step; import sim.experiments.sensitivity as s; s.begin()"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert "imported before its numbers could be replaced" in done.stderr


def test_each_name_of_the_tuning_reads_its_own_value() -> None:
    numbers, reads = sensitivity.tuning()
    for one in numbers.values():
        sensitivity.values[one.at : one.at + one.size] = one.value
    for key, read in reads.items():
        stage, name = key.split(".")
        code = compile(ast.fix_missing_locations(ast.Expression(read)), key, "eval")
        value = getattr(sys.modules[f"service.core.{stage}.tuning"], name)
        np.testing.assert_array_equal(eval(code, {"_memory": sensitivity, "np": np, "math": math}), value, err_msg=key)
    assert set(reads) - set(numbers)  # formulas of other numbers


def test_every_module_of_the_service_reads_its_numbers_while_it_runs() -> None:
    """A default or constant of a module would keep the value that the number had at its import."""
    _, reads = sensitivity.tuning()
    for path in sorted((ROOT / "service").rglob("*.py")):
        if path.name != "tuning.py":
            sensitivity.reading(str(path), path.read_bytes(), reads)


@pytest.mark.parametrize(("value", "half", "double"), [(8, 4, 16), (1, 0, 2), (0.3, 0.15, 0.6)])
def test_a_number_is_halved_and_doubled_and_a_count_stays_one(value: Any, half: Any, double: Any) -> None:
    one = sensitivity.Number("intake", "NAME", value, 0)
    assert (one.changed(0.5), one.changed(2.0)) == (half, double)


def _fails() -> None:
    raise ValueError("no such thing")


@pytest.mark.parametrize(
    ("work", "expected"), [(lambda: {"x": 1.5}, {"x": 1.5}), (_fails, "ValueError: no such thing")]
)
def test_a_fork_returns_a_result_or_an_error(work: Callable[[], Any], expected: Any) -> None:
    assert sensitivity.in_fork(work)() == expected


def test_the_largest_change_is_named_beside_the_noise() -> None:
    tuned = {"figures": {"calm": {"a": 1.0, "b": "nan"}}, "noise": {"calm": {"a": 0.1, "b": "nan"}}}
    row = {
        "changed": {
            "0.5": {"figures": {"calm": {"a": 1.3, "b": 2.0}}},
            "2": {"figures": {"calm": {"a": 0.9, "b": 1.0}}},
        }
    }
    assert sensitivity.worst(row, tuned) == "calm a +0.3 at 0.5 times the value, 3.0 times the noise"
    assert sensitivity.worst({"changed": {"2": {"figures": {}}}}, tuned) == "no session reads it"
    tuned["figures"]["calm"]["c"], tuned["noise"]["calm"]["c"] = 1.0, 0.0  # always succeeds
    row["changed"]["2"]["figures"]["calm"]["c"] = 0.0
    assert (1.0, "2", "calm c", -1.0) in sensitivity.effects(row, tuned)
    row["changed"]["2"]["figures"]["calm"]["a"] = math.nan
    assert "calm a +nan" in sensitivity.worst(row, tuned)
    failed = {"changed": {"2": {"figures": "ZeroDivisionError: division by zero"}}}
    assert next(sensitivity.effects(failed, tuned))[0] == math.inf


def test_no_other_experiment_uses_its_seeds() -> None:
    own = [stream for name, stream in EXPERIMENTS["sensitivity"].seeds.tuning.items()]
    others = [one.seeds for name, one in EXPERIMENTS.items() if name != "sensitivity"]
    theirs = [stream for seeds in others for part in seeds[:3] for stream in part.values()]
    assert [f"{one} and {other}" for one in own for other in theirs if one.overlaps(other)] == []
    assert all(len(stream.numbers) >= sensitivity.EACH for stream in own)


def test_figures_of_new_sessions_join_those_of_earlier_ones() -> None:
    def row(half: Any, double: Any) -> dict[str, Any]:
        return {"value": 1.0, "changed": {"0.5": {"figures": half}, "2": {"figures": double}}}

    joined = sensitivity.joined(row({"calm": {"a": 1.0}}, "no result"), row({"box": {"b": 2.0}}, {"box": {"b": 3.0}}))
    assert joined["changed"]["0.5"]["figures"] == {"calm": {"a": 1.0}, "box": {"b": 2.0}}
    assert joined["changed"]["2"]["figures"] == {"box": {"b": 3.0}}
    assert sensitivity.joined(None, row({}, {})) == row({}, {})
