"""Named environments on maps, for the registry."""

from __future__ import annotations

from typing import Any

from navrep_data.schema import SensorContract
from navrep_data.sim.scenarios import scenario_names

# pepper_2d_simulator.py, set_move_config_aggressive: vx, vy [m/s], omega [rad/s]
MAX_VELOCITY = (0.55, 0.55, 2.0)
# radius 0.3 m and GOAL_REACHED_PADDING 0.2 m
GOAL_RADIUS = 0.5
STEPS = 1000
# original lidars see as far as twice the map's width: 109.44 m on the widest of the scenarios' maps; Mark and CrowdMove
# maps end at 51.2 m
FARTHEST, FARTHEST_SMALL = 110.0, 60.0
# markenv.py: FIRST_TRAIN_MAPS and the like
MARK_MAPS = {
    "mark-train-1": ("marktrain",),
    "mark-test-1": ("marksimple", "markcomplex"),
    "mark-train-2": ("marksimple", "markcomplex", "marktm1", "marktm2", "marktm3"),
    "mark-test-2": ("markclutter", "markmaze"),
}
MARK_DT = 0.5
CROWDMOVE_MAPS = 6
CROWDMOVE_ROBOTS = 10

_COMMON: dict[str, Any] = {
    "world": "map", "humans": 0, "obstacles": 0, "human_policy": "planned", "max_velocity": MAX_VELOCITY,
    "goal_radius": GOAL_RADIUS, "time_limit": STEPS * SensorContract().dt,
}  # fmt: skip
_MARK = {**_COMMON, "sensor": SensorContract(dt=MARK_DT), "time_limit": STEPS * MARK_DT}


def _environments() -> dict[str, tuple[str, dict[str, Any]]]:
    result: dict[str, tuple[str, dict[str, Any]]] = {
        "ian": (
            "the paper's test: 27 scenarios on three maps, planned humans, collisions do damage",
            {**_COMMON, "scenarios": tuple(scenario_names()), "on_collision": "damage", "max_damage": 5.0},
        ),
        "map": (
            "any map (maps=...): random start and goal, planned humans",
            {**_COMMON, "maps": ("asl",), "humans": 5},
        ),
    }
    for name, maps in MARK_MAPS.items():
        use = "training" if "train" in name else "test"
        about = f"Pfeiffer's {use} maps ({', '.join(maps)}): random start and goal, nobody else, steps of 0.5 s"
        result[name] = (about, {**_MARK, "maps": maps})
    for k in range(1, CROWDMOVE_MAPS + 1):
        result[f"crowdmove-{k}"] = (
            f"{CROWDMOVE_ROBOTS} robots jointly on map crowdmove{k}, seen as trunks: random starts and goals",
            {**_COMMON, "maps": (f"crowdmove{k}",), "robots": CROWDMOVE_ROBOTS, "rendering": "trunk"},
        )
    return result


MAP_ENVIRONMENTS = _environments()
"""Name -> (what it is, fields of the config)."""


def original_fields(name: str) -> dict[str, Any]:
    """Return what differs in the config of an environment on maps in `original` physics.

    How far its lidar sees; and its humans are in scenarios only.
    """
    if name not in MAP_ENVIRONMENTS:
        return {}
    far = FARTHEST if name in ("ian", "map") else FARTHEST_SMALL
    sensor = MAP_ENVIRONMENTS[name][1].get("sensor", SensorContract())
    fields: dict[str, Any] = {"sensor": SensorContract(dt=sensor.dt, range_max=far)}
    return {**fields, "humans": 0} if name == "map" else fields
