"""A file of stable-baselines3 is not opened; the refusal says what to write, and that works as it stands."""

import re
import subprocess
import sys
from types import SimpleNamespace

import pytest

from navrep_data.errors import PolicyError
from navrep_data.evaluate.pilots import FunctionPilot
from navrep_data.evaluate.policies import resolve_policy

pytestmark = pytest.mark.slow  # stable-baselines3 takes seconds to import


def test_the_advice_for_a_stable_baselines3_file_works(tmp_path, monkeypatch):
    import gymnasium
    import numpy as np
    from stable_baselines3 import PPO

    class Rooms(gymnasium.Env):
        observation_space = gymnasium.spaces.Dict(
            scan=gymnasium.spaces.Box(0.0, 25.0, (1080,), np.float32),
            robot_state=gymnasium.spaces.Box(-100.0, 100.0, (5,), np.float32),
        )
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)

    monkeypatch.chdir(tmp_path)
    PPO("MultiInputPolicy", Rooms(), n_steps=2, batch_size=2).save("it's mine.zip")
    with pytest.raises(PolicyError, match="holds pickled objects") as refused:
        resolve_policy("./it's mine.zip")
    command = re.search(r"(echo .*) && navrep-data benchmark (.*)$", str(refused.value))
    subprocess.run(["sh", "-c", command[1]], check=True)
    monkeypatch.syspath_prepend(tmp_path)
    drives = resolve_policy(command[2]).make(0)
    assert isinstance(drives, FunctionPilot)
    far = np.full((2, 1080), 30.0, np.float32)
    worlds = SimpleNamespace(n=2, scans=lambda: far, robot_states=lambda: np.zeros((2, 5), np.float32))
    assert drives.act(worlds).shape == (2, 3)
    monkeypatch.delitem(sys.modules, "sb3_policy")
