"""A world model as an environment: nothing but its own predictions after a few real rows.

Notes
-----
Original: ``dreamenv.py`` and ``imdream``. There the action passed acted one step late, since its models are fed the
action that led to a row; a model that is fed the action taken has no such delay.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor

from navrep_data.datasets import SequenceDataset
from navrep_data.errors import ConfigError, check_whole
from navrep_data.models.modular import ModularWorldModel
from navrep_data.models.world_model import CONTEXT, WorldModel
from navrep_data.observations import rings_to_scan
from navrep_data.schema import ACTION_SIZE, DT, N_RAYS, RANGE_MAX, ROBOT_STATE_SIZE, SensorContract
from navrep_data.zoo.local import load_any_model

GOAL_RADIUS = 0.4
"""Distance at which a dreamed goal counts as reached [m]: the mean radius of the robots in the data."""
GOAL_REWARD = 100.0
TIME_LIMIT = 35.0
_REAL_ROWS = 8
_HALF_VIEW = 10.0

Observation = dict[str, NDArray[np.float32]]


class DreamEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """NavRepDream-v0: the robot moves in what a world model predicts.

    Parameters
    ----------
    model : WorldModel, str or path-like
        Modular, joint or transformer: the model, its name in the zoo, or its folder.
    data : path-like
        Dataset that dreams start from.
    split : {"train", "val", "test"} or None
        Part of it.
    temperature : float
        0: always the likeliest next code. Above: codes are drawn, from the modular model's mixture with its weights'
        logarithms divided by the temperature and its widths multiplied by the square root of it; the joint model and
        the transformer predict no distribution, so the width of V's code of the start frame, times the temperature,
        takes its place.
    real_rows : int
        Rows of the dataset that fill the memory before the dream, 1 to 31.
    goal_radius : float
        Distance at which the goal is reached [m].
    source : path-like or str, optional
        Where names are looked for.
    render_mode : str, optional
        ``"rgb_array"``.

    Raises
    ------
    ConfigError
        If a setting cannot be used, or `model` is no world model.

    Notes
    -----
    Observation and action are those of the other environments: Dict(scan (1080,) [m], robot_state (5,)) and
    Box(-1, 1, (3,)), body velocity [m/s, m/s, rad/s]. The scan is decoded from the dreamed code; goal x and y are
    predicted; the velocity is the commanded one, since no model predicts it. Reward: metres nearer to the predicted
    goal, and 100 where it is reached, which terminates; 35 s truncate. ``info["z"]`` is the code, ``info["decoded"]``
    what V makes of it.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": round(1 / DT)}  # noqa: RUF012

    def __init__(
        self,
        model: WorldModel | str | os.PathLike[str],
        data: str | os.PathLike[str],
        *,
        split: Literal["train", "val", "test"] | None = None,
        temperature: float = 0.0,
        real_rows: int = _REAL_ROWS,
        goal_radius: float = GOAL_RADIUS,
        source: str | os.PathLike[str] | None = None,
        render_mode: str | None = None,
    ) -> None:
        found = load_any_model(model, source) if isinstance(model, str | os.PathLike) else model
        if not isinstance(found, WorldModel):
            raise ConfigError(f"model is a {type(found).__name__}, expected a world model such as transformer_1d.")
        if not 0.0 <= temperature <= 10.0:
            raise ConfigError(f"temperature is {temperature}, expected 0 to 10.")
        real_rows = check_whole("real_rows", real_rows, 1, CONTEXT - 1)
        if not 0.0 < goal_radius <= RANGE_MAX:
            raise ConfigError(f"goal_radius is {goal_radius}, expected more than 0 and at most {RANGE_MAX} m.")
        if render_mode not in (None, "rgb_array"):
            raise ConfigError(f"render_mode is {render_mode!r}, expected 'rgb_array' or None.")
        self.model, self.temperature, self.goal_radius = found.eval(), temperature, goal_radius
        self.render_mode = render_mode
        lidar: Any = found.lidar
        # windows of exactly these rows; shorter ones at the ends of episodes are passed over
        self._starts = SequenceDataset(
            Path(data), lidar, window=real_rows, split=split, fields=["robot_state", "action", "goal_valid"],
            scan_unit="normalized", invalid="near",
        )  # fmt: skip
        self._whole = np.flatnonzero(self._starts.table.count == real_rows)
        if len(self._whole) == 0:
            raise ConfigError(f"No episode in {data} has {real_rows} rows, expected longer ones: lower real_rows.")
        self._z, self._goal, self._taken = (torch.zeros(0, dtype=torch.float32, device="cpu") for _ in range(3))
        self._width = torch.zeros(found.z_size, dtype=torch.float32, device="cpu")
        self._steps = 0
        self._obs: Observation | None = None
        self._decoded = np.zeros(0, np.float32)
        self.observation_space: spaces.Space[Any] = spaces.Dict(
            {
                "scan": spaces.Box(0.0, RANGE_MAX, (N_RAYS,), np.float32),
                "robot_state": spaces.Box(-np.inf, np.inf, (ROBOT_STATE_SIZE,), np.float32),
            }
        )
        self.action_space = spaces.Box(-1.0, 1.0, (ACTION_SIZE,), np.float32)

    @torch.no_grad()
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start from rows of the dataset.

        Parameters
        ----------
        seed : int, optional
            Of the choice of rows and of sampled codes.
        options : dict, optional
            ``{"start": k}``: the k-th possible start instead of a random one.
        """
        super().reset(seed=seed)
        chosen = (options or {}).get("start")
        if chosen is not None and not 0 <= int(chosen) < len(self._whole):
            raise ConfigError(f"start is {chosen}, expected 0 to {len(self._whole) - 1}.")
        k = int(self.np_random.integers(len(self._whole))) if chosen is None else int(chosen)
        batch = self._starts.batch([int(self._whole[k])])
        frames = batch["rings" if self.model.lidar == "rings" else "scan"]
        if self.model.lidar == "rings":
            frames[..., 0] = 0.0
        mu, logvar = self.model.vae.distribution(frames)
        self._z, self._width = mu, torch.exp(0.5 * logvar[0, -1])
        self._goal, self._taken = batch["robot_state"][..., :2], batch["action"][:, :-1]
        self._steps = 0
        return self._observe(batch["robot_state"][0, -1, 2:].numpy()), self._info()

    @torch.no_grad()
    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Dream one row on."""
        if self._obs is None:
            raise ConfigError("step was called before reset: call reset() first.")
        command = np.clip(np.asarray(action, np.float32), -1.0, 1.0)
        if command.shape != (ACTION_SIZE,) or not np.isfinite(command).all():
            raise ConfigError(f"action has shape {command.shape}, expected ({ACTION_SIZE},) finite numbers.")
        before = float(torch.linalg.vector_norm(self._goal[0, -1]))
        self._taken = torch.cat([self._taken, torch.from_numpy(command.copy())[None, None]], dim=1)
        next_z, next_goal = self._predict()
        self._z, self._goal = torch.cat([self._z, next_z], dim=1), torch.cat([self._goal, next_goal], dim=1)
        self._steps += 1
        after = float(torch.linalg.vector_norm(self._goal[0, -1]))
        reached = after < self.goal_radius
        reward = GOAL_REWARD if reached else before - after
        late = self._steps * DT >= TIME_LIMIT - 1e-9
        return self._observe(command), reward, reached, late and not reached, self._info()

    def _predict(self) -> tuple[Tensor, Tensor]:
        """Return code and goal of the next row, from the newest rows that the model can look at."""
        led_to = torch.cat([torch.zeros(1, 1, ACTION_SIZE, dtype=torch.float32), self._taken[:, :-1]], dim=1)
        actions = self._taken if self.model.config.action_alignment == "taken" else led_to
        # the modular LSTM was trained to run on; the others see a window
        n = self._z.shape[1] if isinstance(self.model, ModularWorldModel) else CONTEXT
        z, goal, actions = self._z[:, -n:], self._goal[:, -n:], actions[:, -n:]
        h, _ = self.model.hidden(z, goal, actions)
        if isinstance(self.model, ModularWorldModel):
            return self._draw(self.model, h[:, -1:])
        next_z, next_goal = self.model.heads(z[:, -1:], goal[:, -1:], h[:, -1:])
        if self.temperature > 0.0:
            next_z = next_z + self.temperature * self._width * self._normal(next_z.shape)
        return next_z, next_goal

    def _normal(self, shape: tuple[int, ...]) -> Tensor:
        return torch.from_numpy(self.np_random.standard_normal(shape).astype(np.float32))

    def _draw(self, model: ModularWorldModel, h: Tensor) -> tuple[Tensor, Tensor]:
        """Draw a change of code and goal from the mixture; at temperature 0 take the likeliest."""
        mixture = model.memory.mixture(h)
        if self.temperature == 0.0:
            return self._changed(mixture.likeliest())
        share = torch.softmax(mixture.logmix / self.temperature, dim=-1)
        uniform = torch.from_numpy(self.np_random.random((*share.shape[:-1], 1)).astype(np.float32))
        which = (share.cumsum(-1) < uniform).sum(-1, keepdim=True).clamp_max(share.shape[-1] - 1)
        mean, width = mixture.mean.gather(-1, which)[..., 0], mixture.logstd.gather(-1, which)[..., 0].exp()
        change = mean + width * self.temperature**0.5 * self._normal(tuple(mean.shape))
        return self._changed(change)

    def _changed(self, change: Tensor) -> tuple[Tensor, Tensor]:
        n = self._z.shape[-1]
        return self._z[:, -1:] + change[..., :n], self._goal[:, -1:] + change[..., n:] * RANGE_MAX

    def _observe(self, velocity: NDArray[np.float32]) -> Observation:
        decoded = self.model.decode(self._z[:, -1])[0].numpy()
        self._decoded = decoded
        if self.model.lidar == "rings":
            scan = rings_to_scan(np.ascontiguousarray(decoded * 2.0), N_RAYS)
        else:
            scan = decoded * np.float32(RANGE_MAX)
        state = np.concatenate([self._goal[0, -1].numpy(), velocity]).astype(np.float32)
        self._obs = {"scan": np.clip(scan, 0.0, RANGE_MAX).astype(np.float32), "robot_state": state}
        return {name: value.copy() for name, value in self._obs.items()}

    def _info(self) -> dict[str, Any]:
        return {"z": self._z[0, -1].numpy().copy(), "decoded": self._decoded.copy(), "dreamed": self._steps}

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture (H, W, 3): the decoded scan from above with the goal, beside what V decoded."""
        if self.render_mode is None or self._obs is None:
            return None
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        from navrep_data.sim.drawing import scan_points

        figure = Figure(figsize=(7.0, 3.4), dpi=80, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        above, beside = figure.subplots(1, 2)
        points = scan_points(self._obs["scan"], (0.0, 0.0, 0.0), SensorContract())
        # a goal beyond the picture is drawn at its edge
        goal = np.clip(self._obs["robot_state"][:2], -_HALF_VIEW, _HALF_VIEW)
        above.plot(points[:, 0], points[:, 1], ".", markersize=1.2, color="#1d3557")
        above.plot([0], [0], "o", color="#d1495b", label="robot")
        above.plot([goal[0]], [goal[1]], "*", markersize=11, color="#3a7d44", label="goal, predicted")
        above.set_xlim(-1.05 * _HALF_VIEW, 1.05 * _HALF_VIEW)
        above.set_ylim(-1.05 * _HALF_VIEW, 1.05 * _HALF_VIEW)
        above.set_aspect("equal")
        above.set_title(f"dreamed {self._steps * DT:.1f} s", fontsize=9)
        above.legend(fontsize=7, loc="upper right")
        if self.model.lidar == "rings":
            beside.imshow(self._decoded.T, origin="lower", vmin=0, vmax=1, cmap="gray_r", aspect="auto")
            beside.set_xlabel("angle (section)")
            beside.set_ylabel("range (cell)")
        else:
            beside.plot(self._decoded * RANGE_MAX, linewidth=0.8, color="#1d3557")
            beside.set_xlabel("ray")
            beside.set_ylabel("range [m]")
        beside.set_title("decoded", fontsize=9)
        canvas.draw()  # type: ignore[no-untyped-call]
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Close the dataset's files."""
        self._starts.close()


gymnasium.register(id="NavRepDream-v0", entry_point="navrep_data.zoo.dream:DreamEnv", disable_env_checker=True)
