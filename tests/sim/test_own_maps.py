"""Maps of one's own in the simulator: random starts, humans, errors, and generation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from navrep_data.errors import MapError, SimulationError
from navrep_data.schema import Event
from navrep_data.sim import (
    RolloutSettings,
    Scenario,
    ScriptedMapRollout,
    ScriptedPolicy,
    Simulator,
    load_map,
    make_config,
    scenarios,
)
from navrep_data.sim.map_tables import spawn_places
from navrep_data.sim.maps import GridMap, planning_map

FREE, SOLID = 254, 0


def write_map(folder: Path, grey: np.ndarray, resolution: float = 0.1, name: str = "hall") -> str:
    """Write a map folder, its lower left corner at (-1, -2)."""
    folder.mkdir(exist_ok=True)
    Image.fromarray(grey.astype(np.uint8)).save(folder / f"{name}.png")
    (folder / f"{name}.yaml").write_text(
        f"image: {name}.png\nresolution: {resolution}\norigin: [-1.0, -2.0, 0.0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n",
        encoding="utf-8",
    )
    return str(folder)


def hall() -> np.ndarray:
    """Return two rooms of 8 x 6 m with a door of 1.5 m between them."""
    grey = np.full((62, 162), FREE)
    grey[[0, -1], :] = SOLID
    grey[:, [0, -1]] = SOLID
    grey[:, 80:82] = SOLID
    grey[24:39, 80:82] = FREE
    return grey


@pytest.fixture
def path(tmp_path: Path) -> str:
    return write_map(tmp_path / "hall", hall())


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["planned", "orca", "constant-velocity", "static"])
def test_humans_start_free_and_stay_out_of_walls(path: str, policy: str) -> None:
    simulator = Simulator(make_config("map", maps=(path,), humans=4, human_policy=policy), 4, seed=2)
    start = [simulator.state(w).humans[:, :2].copy() for w in range(4)]
    for w in range(4):
        state = simulator.state(w)
        everybody = np.concatenate([state.robot[None, :2], state.humans[:, :2]])
        assert 2 <= len(state.humans) <= 6
        assert (simulator.clearance(everybody, w) >= 0.3).all()
        gaps = np.hypot(*(everybody[:, None] - everybody[None]).transpose(2, 0, 1))
        assert (gaps[~np.eye(len(everybody), dtype=bool)] > 0.6).all()
    for _ in range(100):
        simulator.step(np.zeros((4, 3)))
        for w in range(4):
            assert (simulator.clearance(simulator.state(w).humans[:, :2], w) > 0.05).all()
    moved = np.concatenate([np.hypot(*(simulator.state(w).humans[:, :2] - start[w]).T) for w in range(4)])
    assert (moved.max() == 0.0) == (policy == "static")
    assert (moved > 1.0).any() != (policy == "static")


@pytest.mark.parametrize(("shape", "resolution", "room"), [
    ((1, 200), 0.05, False), ((200, 1), 0.05, False), ((3, 60), 0.1, False), ((1, 1), 0.05, False),
    ((1, 9), 1.5, True), ((9, 1), 2.0, True), ((1, 1), 4.0, True),
])  # fmt: skip
@pytest.mark.parametrize("name", ["thin", "crowdmove1"])
def test_maps_of_one_column_or_row(name: str, shape: tuple[int, int], resolution: float, room: bool) -> None:
    """They serve where a robot fits on them; else it is said that none does, not that halving them failed."""
    grid = GridMap(name, np.zeros(shape), resolution, (0.0, 0.0), source=f"{name}.yaml")
    assert planning_map(grid).shape == shape
    if room:
        assert len(spawn_places(grid)) == max(shape)
    else:
        with pytest.raises(MapError, match=r"no place that is 0\.5 m from all walls"):
            spawn_places(grid)


@pytest.mark.parametrize("robots", [1, 2])
def test_robot_states_are_those_of_observe(path: str, robots: int) -> None:
    simulator = Simulator(make_config("map", maps=(path,), humans=0, robots=robots), 2, seed=2)
    simulator.step(np.broadcast_to([0.3, -0.2, 0.5], (2, 3) if robots == 1 else (2, robots, 3)))
    states = simulator.robot_states()
    np.testing.assert_array_equal(states, simulator.observe()[1])
    assert states[..., 4] == pytest.approx(0.5)


@pytest.mark.parametrize("robots", [1, 2])
@pytest.mark.parametrize("inertia", ["none", "limited"])
def test_a_differential_robot_never_slides_sideways(path: str, inertia: str, robots: int) -> None:
    """Whatever it is told, its steps and the velocity that it shows lie along its heading."""
    config = make_config("map", maps=(path,), humans=0, robots=robots, drive="differential", inertia=inertia)
    simulator = Simulator(config, 4, seed=3)
    commands = np.repeat(np.random.default_rng(0).uniform(-1, 1, (6, 4, robots, 3)), 5, axis=0)
    moved = 0.0
    for command in commands:
        before = np.stack([simulator.state(w).robots[:, :3] for w in range(4)])
        simulator.step(command if robots > 1 else command[:, 0])
        after = np.stack([simulator.state(w).robots[:, :3] for w in range(4)])
        step, heading = after[..., :2] - before[..., :2], before[..., 2]
        sideways = np.cos(heading) * step[..., 1] - np.sin(heading) * step[..., 0]
        assert np.abs(sideways).max() < 1e-9
        states = simulator.robot_states()
        assert np.abs(states[..., 3]).max() == 0.0
        moved = max(moved, float(np.abs(states[..., 2]).max()))
    assert moved > 0.3


def test_inertia_of_a_differential_robot_keeps_its_limits(path: str) -> None:
    limits = {"robot_acceleration": (0.6, 0.4, 1.5), "robot_jerk": (2.0, 1.0, 4.0)}
    config = make_config("map", maps=(path,), humans=0, drive="differential", inertia="limited", **limits)
    simulator = Simulator(config, 1, seed=3)
    speeds = []
    for command in np.repeat(np.random.default_rng(0).uniform(-0.5, 0.5, (6, 1, 3)), 7, axis=0):
        simulator.step(command)
        speeds.append(simulator.robot_states()[0, [2, 4]].astype(float))
    change = np.diff(speeds, axis=0) / 0.2
    assert (np.abs(change) <= np.array([0.6, 1.5]) + 1e-6).all()
    assert (np.abs(np.diff(change, axis=0)) <= np.array([2.0, 4.0]) * 0.2 + 1e-5).all()


def test_orca_robot_finds_the_door(path: str) -> None:
    """The planner-guided ORCA robot gets from room to room; ORCA alone would push against the wall."""
    config = make_config("map", maps=(path,), humans=0)
    rollout = ScriptedMapRollout(config, RolloutSettings(1500, humans=False, rings=False), ScriptedPolicy("orca"), 1)
    columns, worlds = rollout.run([0])[0]
    ends = columns["event"][columns["is_last"]]
    crossing = (worlds["robot_start"][:, 0] < 7.0) != (worlds["robot_goal"][:, 0] < 7.0)
    assert crossing[:-1].any()
    assert (ends[:-1] == Event.GOAL).all()
    speed = np.hypot(columns["action"][:, 0], columns["action"][:, 1])
    assert speed.max() <= 0.55 + 1e-6
    assert set(worlds["map"]) == {b"hall"}
    assert set(worlds["map_hash"]) == {load_map(path).local.hash.encode()}
    assert set(worlds["scenario"]) == {b""}


def test_rollouts_do_not_depend_on_what_ran_before(path: str) -> None:
    config = make_config("map", maps=(path,), humans=3)
    settings = RolloutSettings(120)
    fresh = ScriptedMapRollout(config, settings, ScriptedPolicy("orca"), 7).run([5])[0]
    used = ScriptedMapRollout(config, settings, ScriptedPolicy("orca"), 7)
    used.run([4])
    again = used.run([5])[0]
    for name in fresh[0]:
        np.testing.assert_array_equal(fresh[0][name], again[0][name])


def test_lidar_and_robot_meet_the_same_rim(tmp_path: Path) -> None:
    """A map without walls ends at its edge, for the lidar as for the robot."""
    path = write_map(tmp_path / "open", np.full((60, 60), FREE))
    simulator = Simulator(make_config("map", maps=(path,), humans=0))
    for _ in range(60):
        robot = simulator.state().robot
        ahead = simulator.observe()[0][0, 0]
        _, event = simulator.step(np.array([[0.55, 0.0, 0.0]]))
        if event[0]:
            break
        c, s = np.cos(robot[2]), np.sin(robot[2])
        end = robot[:2] + ahead * np.array([c, s])
        assert min(abs(end[0]), abs(end[0] - 6.0), abs(end[1]), abs(end[1] - 6.0)) < 1e-4
    assert event[0] in (Event.COLLISION_OBSTACLE, Event.GOAL)


def test_a_map_without_room_is_refused(tmp_path: Path) -> None:
    grey = np.full((40, 40), FREE)
    grey[::4] = SOLID
    with pytest.raises(MapError, match=r"has no place that is 0\.5 m from all walls"):
        Simulator(make_config("map", maps=(write_map(tmp_path / "full", grey),), humans=0))


def test_a_map_too_small_for_a_goal_is_refused(tmp_path: Path) -> None:
    grey = np.full((30, 30), FREE)
    with pytest.raises(SimulationError, match="No start and goal for 1 robots on map 'hall'"):
        Simulator(make_config("map", maps=(write_map(tmp_path / "small", grey),), humans=0))


@pytest.mark.parametrize(
    ("who", "place", "words"),
    [
        (
            0,
            (7.05, 1.0),
            r"Scenario 's': the start \(7.05, 1\) is inside a wall or on unknown ground on map 'hall', expected",
        ),
        (
            1,
            (-0.75, 1.0),
            r"\(-0.75, 1\) is 0.20 m from the nearest wall on map 'hall', expected at least 0.3 m of free",
        ),
        (1, (40.0, 1.0), r"the start \(40, 1\) is outside map 'hall', expected at least"),
        (2, (12.0, 1.0), r"the goal \(12, 1\) on map 'hall' is out of reach from \(2, 1\)"),
        (3, (12.0, 1.0), r"the goal \(12, 1\) on map 'hall' is out of reach from \(4, 3\)"),
        (2, (2.0, 40.0), r"the goal \(2, 40\) on map 'hall' is out of reach from \(2, 1\)"),
        (None, (), ""),
    ],
)
def test_starts_in_walls_and_goals_out_of_reach_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, who: int | None, place: tuple[float, ...], words: str
) -> None:
    """A scenario of robot and human, one of their starts (0, 1) or goals (2, 3) put elsewhere; the door is shut."""
    grey = hall()
    grey[:, 80:82] = SOLID
    path = write_map(tmp_path / "closed", grey)
    points = np.array([(2.0, 1.0), (4.0, 3.0), (5.0, 3.0), (3.0, 0.0)])
    if who is not None:
        points[who] = place
    scenario = Scenario("s", path, np.column_stack([points[:2], np.zeros(2)]), points[2:], np.ones(2))
    known = {**scenarios._scenarios(), "s": scenario}
    monkeypatch.setattr(scenarios, "_scenarios", lambda: known)
    config = make_config("ian", scenarios=("s",))
    if who is None:
        simulator = Simulator(config)
        assert simulator.state().robot[:2] + simulator.origins[0] == pytest.approx([2.0, 1.0])
        return
    with pytest.raises(MapError, match=words) as caught:
        Simulator(config)
    assert "\n" not in str(caught.value)


def test_spawn_places_keep_their_distance(path: str) -> None:
    grid = load_map(path)
    places = spawn_places(grid)
    assert len(places) > 500
    assert (grid.signed_distance()[tuple(grid.cell_of(places).T)] >= 0.4).all()
