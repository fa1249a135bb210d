"""Rules of the architecture that can be checked: imports, names, first lines."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from support import tiers
from support.cell_commands import python
from support.paths import ROOT

PACKAGES = {"kmp": "", "thirdhand": "service", "thirdhand_sim": "sim"}  # the folder of each package
VAGUE = {
    "utils",
    "util",
    "common",
    "base",
    "manager",
    "helper",
    "helpers",
    "node",
    "interface",
    "misc",
}
# access to private names in code strings of tests, or in names that they patch
PRIVATE = r"[a-z]\._[a-z]|, \"_[a-z]"
SCRIPTS = {*(ROOT / "kmp" / "docs").rglob("*.py")}  # of kmp's site
MODULES = sorted(
    {
        path
        for folder in ("kmp", "service", "sim", "tests")
        for path in (ROOT / folder).rglob("*.py")
    }
    - SCRIPTS
)
ENTRY_POINTS = [
    path
    for path in MODULES
    if not path.is_relative_to(ROOT / "tests")
    and 'if __name__ == "__main__"' in path.read_text(encoding="utf-8")
]
# Numbers of the core's stages that are codes or sizes of arrays.
STRUCTURAL = """
    BEGIN_AT BOUNDED CHASED CLOSED CLOSURE_ROUND_TO COVARIANCE_ROUND_TO FARTHEST_REPORTED_M
    GONE HOME_AT HULL_SPANS IS_AMBIGUOUS IS_OUTSIDE ITSELF KEPT LEFT LONGEST_AT
    LONGEST_CLOCK_S MAX_SKILL_DISTANCE_M MODES MOST_CLOCK_WEIGHT MOST_SEGMENTS
    MOTION_ROUND_TO NEAR NEAR_AT NEAR_BEGIN NEAR_HAND NEAR_ITSELF NEIGHBOURS NONE NOT_BEGUN
    NO_GRIPPER NO_SEGMENT NO_TREMOR OPEN ORDER OUTPUTS OVER_AT PACE_AT PEOPLE REQUESTED
    REST_AT RIGHT RUNS SIGNS SEPARATED SPEED STATES STAYS TABLE_DEPTH_M THINGS TREMOR_RATES
    TURNS TURN_INPUTS TURN_ROUND_TO UNKNOWN UNSAFE UNUSABLE USUAL_RATE WAITS WAY MOST_WISHES
"""
# `KMP.save` and `KMP.load` import the storage of primitives
CONVENIENCES = {("kmp.primitive", "kmp.storage")}
IN_EVERY_STAGE = {"FRAME", "STATE"}  # each stage's own fields of frame and state
# Names of constants and classes that are still defined twice. Add none.
NAMED_TWICE = """
    ARM BLOCK BLOCKS COLOURS COVARIANCE_ROUND_TO Evidence HANDS Hyperparameters KEPT KMP
    LEFT LEVELS MACHINE NEAR NEAREST NONE OBJECTS OTHERS Options Outcome PEOPLE Percentiles
    Pose RIGHT ROOT SEPARATED STAGES Solution Stuck T TIMES TIMING TOLERANCE TOOL Task USUAL
    WayOut _ATTACHMENT _FREE _LENGTH _MACHINE _NAMES _NOISES _RESIDUAL _ROUNDS _SHOWN
    _System _TICK _TINY
"""
# lines that break contracts, by the kind of violation, and the contracts that they break
PLANTED = {
    "what comes from outside": (
        {
            "service/thirdhand/core/intake/stage.py": "import time",
            "service/thirdhand/contract/cdr.py": "import numpy",
            "service/thirdhand/workbench/learning/learn.py": "import mcap",
            "kmp/mixture.py": "import msgspec",
        },
        {
            "the core has no clock and no input or output",
            "the contract imports the standard library and msgspec only",
            "learning opens no network and no recording",
            "the mathematics stands alone",
        },
    ),
    "the order of rooms": (
        {
            "service/thirdhand/core/frame.py": "from thirdhand.daemon.clock import Deadlines",
            "service/thirdhand/contract/channels.py": "from thirdhand.core.frame import Tick",
            "service/thirdhand/scribe/scribe.py": "from thirdhand.daemon.clock import Deadlines",
            "service/thirdhand/daemon/clock.py": "from thirdhand.cli.usage import UsageError",
            "service/thirdhand/core/skill/skill.py": "from thirdhand.workbench.learning.learn "
            "import learn",
            "kmp/mixture.py": "from thirdhand.settings.config import Settings",
            "service/thirdhand/settings/config.py": "from thirdhand_sim.scene import Scene",
        },
        {
            "the simulation may use the service, the service the method, never back",
            "the workbench may use the run-time, never back, and each room the rooms below it",
        },
    ),
    "a module outside of every room": (
        {"service/thirdhand/somewhere_else.py": '"""A module."""'},
        {"the workbench may use the run-time, never back, and each room the rooms below it"},
    ),
}


def named(path: Path) -> str:
    """The path relative to the root."""
    return str(path.relative_to(ROOT))


def imported(path: Path) -> set[str]:
    """The first parts of the names of all modules that a file imports, at any level."""
    packages: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            packages |= {name.name.split(".")[0] for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            packages.add(node.module.split(".")[0])
    return packages


def modules_imported(folder: Path) -> dict[str, set[str]]:
    """The modules of PACKAGES that each module imports, also in functions and for types only."""
    names: dict[str, Path] = {}
    for package, place in PACKAGES.items():
        for path in (folder / place / package).rglob("*.py"):
            module = ".".join(path.relative_to(folder / place).with_suffix("").parts)
            names[module.removesuffix(".__init__")] = path
    graph: dict[str, set[str]] = {}
    for module, path in names.items():
        imports: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                imports |= {name.name for name in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                parts = {f"{node.module}.{name.name}" for name in node.names}
                imports |= (
                    parts & names.keys()
                    if parts <= names.keys()
                    else parts & names.keys() | {node.module}
                )
        graph[module] = (imports & names.keys()) - {module}
    return graph


def circle(imports: dict[str, set[str]]) -> list[str]:
    """Modules that import each other in a circle; empty if there is none."""
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def contracts(folder: Path) -> subprocess.CompletedProcess[str]:
    """The results of the import contracts in a source tree."""
    code = (
        "import sys; from importlinter.cli import lint_imports_command; "
        "sys.exit(lint_imports_command())"
    )
    environment = os.environ | {
        "PYTHONPATH": f"{folder}:{folder / 'service'}:{folder / 'sim'}",
        "COLUMNS": "200",
    }
    return python(code, "--no-cache", timeout=120, cwd=folder, env=environment)


def test_import_contracts_hold() -> None:
    done = contracts(ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout


def test_no_modules_import_each_other_in_a_circle() -> None:
    imports = modules_imported(ROOT)
    for module, other in CONVENIENCES:
        imports[module].remove(other)
    assert circle(imports) == []


@pytest.mark.parametrize(
    "late", ["def f():\n    import thirdhand.a", "if TYPE_CHECKING:\n    from thirdhand.a import A"]
)
def test_a_circle_is_found_also_in_functions_and_for_types_alone(late: str, tmp_path: Path) -> None:
    folder = tmp_path / "service" / "thirdhand"
    folder.mkdir(parents=True)
    for name, text in (
        ("a", "from thirdhand import b"),
        ("b", "from thirdhand.c import C"),
        ("c", late),
    ):
        (folder / f"{name}.py").write_text(text, encoding="utf-8")
    assert set(circle(modules_imported(tmp_path))) == {"thirdhand.a", "thirdhand.b", "thirdhand.c"}


@pytest.mark.parametrize(("lines", "broken"), PLANTED.values(), ids=PLANTED)
def test_lines_that_break_a_contract_are_found_and_named(
    lines: dict[str, str], broken: set[str], tmp_path: Path
) -> None:
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for folder in ("kmp", "service", "sim"):
        shutil.copytree(
            ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__")
        )
    for path, line in lines.items():
        with (tmp_path / path).open("a", encoding="utf-8") as file:
            file.write(f"\n{line}\n")
    done = contracts(tmp_path)
    assert done.returncode == 1, done.stdout
    assert broken <= set(re.findall(r"^(.*) BROKEN(?: \(.*\))?$", done.stdout, re.MULTILINE)), (
        done.stdout
    )
    for path, line in lines.items():
        module = path.removesuffix(".py").removeprefix("service/").replace("/", ".")
        brought = f" -> {line.split()[1]} (l." if "import" in line else "\n"
        assert f"- {module}{brought}" in re.sub("-  +", "- ", done.stdout), done.stdout


@pytest.mark.parametrize(
    ("process", "most", "without"),
    [
        (
            "thirdhand.daemon.daemon",
            205,
            ("thirdhand.workbench", "thirdhand_sim", "rerun", "mcap", "sklearn", "rich"),
        ),
        (
            "thirdhand.scribe.process, thirdhand.viewer.stream",
            82,
            (
                "thirdhand.workbench",
                "thirdhand.daemon",
                "pinocchio",
                "ruckig",
                "zenoh",
                "sklearn",
                "kmp.primitive",
            ),
        ),
    ],
    ids=["control process", "scribe"],
)
def test_a_process_of_a_cell_imports_what_it_needs(
    process: str, most: int, without: tuple[str, ...]
) -> None:
    modules = python(f"import sys, {process}; print(*sys.modules)").stdout.split()
    assert process.split(",", maxsplit=1)[0] in modules
    assert [name for name in modules if name.startswith(without)] == []
    assert len([name for name in modules if name.split(".")[0] in PACKAGES]) <= most


@pytest.mark.parametrize("path", ENTRY_POINTS, ids=named)
def test_entry_points_ask_for_one_blas_thread_first(path: Path) -> None:
    """Only the standard library may be imported before."""
    imports = (
        node
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.Import | ast.ImportFrom)
    )
    names = ((node, getattr(node, "module", None) or node.names[0].name) for node in imports)
    first = next(node for node, name in names if name.split(".")[0] not in sys.stdlib_module_names)
    assert isinstance(first, ast.ImportFrom)
    assert (first.module, [name.name for name in first.names]) == (
        "thirdhand.process",
        ["one_blas_thread"],
    )


def test_the_mathematics_imports_nothing_but_mathematics() -> None:
    allowed = {
        "numpy",
        "scipy",
        "numba",
        "sklearn",
        "threadpoolctl",
        "kmp",
        *sys.stdlib_module_names,
    }
    for path in (path for path in MODULES if path.is_relative_to(ROOT / "kmp")):
        assert imported(path) <= allowed | ({"matplotlib"} if path.name == "plot.py" else set()), (
            named(path)
        )


def test_a_module_begins_with_what_it_is() -> None:
    texts = {named(path): path.read_text(encoding="utf-8") for path in MODULES}
    assert [name for name, text in texts.items() if not re.match(r'"""\S', text)] == []
    assert [name for name, text in texts.items() if not ast.get_docstring(ast.parse(text))] == []


def test_no_module_has_a_name_that_says_nothing() -> None:
    ours = [path for path in MODULES if "stand_in" not in path.parts]
    assert [named(path) for path in ours if path.stem in VAGUE or path.parent.name in VAGUE] == []


def defined(path: Path) -> set[str]:
    """The classes and constants that a module defines at its top level."""
    identifiers: set[str] = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef):
            identifiers.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            nodes = [node for target in targets for node in ast.walk(target)]
            names = [node for node in nodes if isinstance(node, ast.Name)]
            identifiers |= {
                name.id
                for name in names
                if isinstance(name.ctx, ast.Store) and name.id.strip("_").isupper()
            }
    return identifiers


def test_a_class_or_constant_has_a_name_of_its_own() -> None:
    """A search for a name then finds one definition."""
    modules: dict[str, list[str]] = {}
    for path in (path for path in MODULES if not path.is_relative_to(ROOT / "tests")):
        for name in defined(path) - IN_EVERY_STAGE - set(NAMED_TWICE.split()):
            modules.setdefault(name, []).append(named(path))
    assert len(modules) > 500
    assert {name: places for name, places in modules.items() if len(places) > 1} == {}


def test_tests_share_support_and_never_import_each_other() -> None:
    tests = [path for path in MODULES if path.is_relative_to(ROOT / "tests")]
    theirs = {
        path.stem for path in tests if not path.is_relative_to(ROOT / "tests" / "support")
    } | {"tests"}
    assert [named(path) for path in tests if imported(path) & theirs] == []


def test_tests_ask_for_nothing_private_by_import_or_in_a_string() -> None:
    """The linter finds private attributes."""
    findings = []
    for path in (path for path in MODULES if path.is_relative_to(ROOT / "tests")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if (
                isinstance(node, ast.ImportFrom)
                and node.module
                and node.module.split(".")[0] in PACKAGES
            ):
                findings += [
                    f"{named(path)}: {name.name}"
                    for name in node.names
                    if re.match("_[a-z]", name.name)
                ]
            elif isinstance(node, ast.Constant) and re.search(PRIVATE, str(node.value)):
                findings.append(f"{named(path)}: {node.value}")
    assert findings == []


def test_every_file_that_a_tier_names_exists() -> None:
    for file in (*tiers.REAL_STARTS, *tiers.LONGEST_FIRST):
        assert (ROOT / "tests" / file).exists(), file


def test_constraints_name_versions_and_no_places() -> None:
    lines = (ROOT / ".ci" / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line for line in lines if line.strip() and not line.startswith("#")]
    assert pins
    assert [
        pin for pin in pins if not re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.!+_-]+", pin)
    ] == []
    assert [line for line in lines if re.search(r"://|--(extra-)?index|--find-links|@", line)] == []


def test_a_stage_keeps_its_numbers_apart_and_its_step_to_itself() -> None:
    """Tuned numbers are in tuning.py, compiled functions in step.py, the class in stage.py; no
    stage imports another stage's step.
    """
    core = ROOT / "service" / "thirdhand" / "core"
    stages = sorted(path.parent for path in core.glob("*/stage.py"))
    assert len(stages) == 8
    for stage in stages:
        assert {"step.py", "stage.py"} <= {path.name for path in stage.glob("*.py")}
        for path in stage.glob("*.py"):
            text = path.read_text(encoding="utf-8")
            others = [
                s.name
                for s in stages
                if s != stage and f"thirdhand.core.{s.name}.step import" in text
            ]
            assert not others, f"{named(path)} imports the step of {others}"
            loose = re.findall(r"^([A-Z][A-Z0-9_]+) = [-\d.e]+ *(?:#|$)", text, re.MULTILINE)
            assert path.name == "tuning.py" or not [
                n for n in loose if n not in STRUCTURAL.split()
            ], f"{named(path)}: {loose}"
