"""Compiles the kernels that most tests need: ``python compile_kernels.py polygons`` or ``maps``.

Test processes that start at the same time with an empty cache would each compile all of them.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from navrep_data.generate import generate
from navrep_data.sim import Simulator, make_config
from navrep_data.sim.maps import map_names

ENVIRONMENTS = {"polygons": ("soadrl", "navrep-test"), "maps": ("crowdmove-1", "ian") if map_names() else ()}

for env in ENVIRONMENTS[sys.argv[1]]:
    for physics in ("consistent", "original"):
        with tempfile.TemporaryDirectory() as folder:
            generate(env=env, physics=physics, n=1, length=10, out=Path(folder, "d"))
        simulator = Simulator(make_config(env, physics=physics), n_worlds=2, seed=0)
        simulator.reset()
        for _ in range(2):
            _, robot_states = simulator.observe()
            simulator.step(np.zeros((*robot_states.shape[:-1], 3)))
