"""A file of stable-baselines3 is not opened; the refusal says what to write, and that works as it stands."""

import os
import re
import subprocess
import sys

import pytest

from navrep_data.errors import PolicyError
from navrep_data.evaluate.policies import resolve_policy

pytestmark = pytest.mark.slow  # stable-baselines3 and a process of its own


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
    command = re.search(r"(echo .*) && navrep-data (benchmark .*)$", str(refused.value))
    subprocess.run(["sh", "-c", command[1]], check=True)
    played = subprocess.run(
        [sys.executable, "-m", "navrep_data", *command[2].split(), "--episodes", "2", "--no-figures"],
        capture_output=True, text=True, env=dict(os.environ), timeout=500,
    )  # fmt: skip
    assert played.returncode == 0, played.stderr
    assert "sb3_policy:act" in played.stdout
