"""One bench, two engines: the same scene with the same scores."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator

import numpy as np
import pytest

from support.demo import SCENE, soldered
from thirdhand.daemon.launch import ENGINES, LaunchError, engine_of
from thirdhand_sim.bench import Bench
from thirdhand_sim.engines import world_of
from thirdhand_sim.scene import Point
from thirdhand_sim.script import HandScript
from thirdhand_sim.world import LEVEL, Pose, pixels

EYE = (1.66, -0.78, 0.80)
TARGET = (0.53, -0.02, 0.31)
SIZE = (160, 120)


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest) -> str:
    if importlib.util.find_spec(request.param) is None:
        pytest.skip(f"{ENGINES[request.param]} is not installed")
    return str(request.param)


@pytest.fixture
def bench(engine: str) -> Iterator[Bench]:
    with Bench(HandScript(SCENE, seed=1), world=world_of(engine)) as built:
        yield built


def test_engines_give_same_scores() -> None:
    """The arm's paths agree too."""
    if missing := [name for name in ENGINES if importlib.util.find_spec(name) is None]:
        pytest.skip(f"{ENGINES[missing[0]]} is not installed")
    result, other = (soldered(world=world_of(name)) for name in ENGINES)
    assert result.events.success
    assert other.events.success
    assert max(*result.errors_mm, *other.errors_mm) < 3.0
    assert np.abs(np.subtract(result.errors_mm, other.errors_mm)).max() < 0.1, (
        result.errors_mm,
        other.errors_mm,
    )
    apart_mm = 1000 * np.linalg.norm(result.tool - other.tool, axis=1)
    assert 0.0 < apart_mm.max() < 1.0, f"{apart_mm.max():.3f} mm"


@pytest.mark.quick
def test_arm_follows_within_a_millimetre(bench: Bench) -> None:
    """The arm follows moving commands."""
    start = np.array(bench.observe().joints)
    wrong = []
    for tick in range(1000):
        t = 0.002 * tick
        position = start + 0.2 * (1 - np.cos(2 * t))
        velocity = np.full(7, 0.4 * np.sin(2 * t))
        observation = bench.step(tuple(position), tuple(velocity))
        # Velocity is fed forward: the arm is at the commanded position at the start of a period,
        # and one period further at its end.
        wrong.append(np.abs(np.array(observation.joints) - position - 0.002 * velocity).max())
    assert max(wrong) < 1e-4  # [rad]


def test_motors_are_no_stronger_than_described(bench: Bench) -> None:
    """The motors' efforts are those of the description."""
    start = np.array(bench.observe().joints)
    # a motor of 60 N m cannot reach this speed of the stretched arm in 40 ms
    for _ in range(20):
        bench.world.follow(
            tuple(start + np.array([0, -2.0, 0, 0, 0, 0, 0])), (0.0, -100.0, *(0.0,) * 5)
        )
        bench.world.step()
    turned = np.array(bench.world.joints()[1])
    assert turned[1] == pytest.approx(-1.76, abs=0.05)  # [rad/s], 100 are commanded
    assert np.abs(np.delete(turned, 1)).max() < 0.05  # stronger motors hold their position


def test_only_the_table_stops_the_arm(bench: Bench) -> None:
    world = bench.world
    tool = world.tool()[0].position
    world.put(world.left, Pose(tool, LEVEL))  # a hand at the tool does not push it
    start = world.joints()[0]
    for _ in range(50):
        world.step()
    assert world.clearance(world.left) < 0
    assert world.joints()[0] == pytest.approx(start, abs=1e-3)
    down = np.array(start)
    for _ in range(1500):  # forward and down, into the table
        down = down + 0.002 * np.array([0, 0.6, 0, 0, 0, 0, 0])
        world.follow(tuple(down), (0.0,) * 7)
        world.step()
    assert world.joints()[0][1] < down[1] - 0.5
    assert world.tool()[0].position[2] > -0.05  # the forearm lies on the table's edge


def test_clearance_of_a_hand(bench: Bench) -> None:
    """The distance follows from the hand's shape."""
    world = bench.world
    assert world.clearance(world.left) == pytest.approx(0.603, abs=2e-3)
    assert world.clearance(world.left, within=0.3) == pytest.approx(0.3)
    x, y, z = world.tool()[0].position
    world.put(world.left, Pose((x + 0.3, y, z - 0.3), LEVEL))  # its forearm reaches the arm
    assert world.clearance(world.left) < 0.3


def test_pictures_show_what_is_there(bench: Bench) -> None:
    try:
        colours, matrix = bench.world.picture(eye=EYE, target=TARGET, size=SIZE)
    except (ImportError, RuntimeError) as error:
        pytest.skip(f"pictures of this engine need GL: {error}")
    assert colours.shape == (120, 160, 3)
    assert (colours[0, 0] == 255).all()  # the sky

    def redness(point: Point) -> int:
        """The red of a point in the picture, less its blue."""
        (across, down), *_ = pixels(np.array([point]), matrix, SIZE)
        red, _, blue = colours[round(down), round(across)].astype(int)
        return int(red - blue)

    x, y, z = SCENE.solder
    assert abs(redness((x, y, z + 0.015))) < 40  # grey: it stands on wood
    assert redness((1.0, -0.1, 0.0)) > 40


def test_missing_engine_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "thirdhand.daemon.launch.ENGINES", {"none_such": "NoneSuch", "msgspec": "Msgspec"}
    )
    assert engine_of() == "msgspec"
    with pytest.raises(LaunchError, match="needs NoneSuch, which is not installed"):
        engine_of("none_such")
