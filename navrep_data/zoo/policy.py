"""A policy: scan and robot state in, velocity out. Encoder, memory and controller joined, for a batch of robots."""

from __future__ import annotations

import copy
import hashlib
import math
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from navrep_data.errors import ArrayError, CheckpointError, ConfigError, PolicyError, check_whole
from navrep_data.models.checkpoint import building
from navrep_data.models.config import OBSERVATION_SHAPES
from navrep_data.models.controllers import ActorCritic, EndToEnd
from navrep_data.models.encoder import FrozenEncoder
from navrep_data.models.noise import Noise
from navrep_data.models.observation import observation_from_scan
from navrep_data.models.vae import VAE
from navrep_data.models.world_model import Stream, WorldModel
from navrep_data.observations import RobotScale, fill_blind
from navrep_data.schema import ACTION_SIZE, INFERENCE, RANGES, ROBOT_STATE_SIZE, RobotContract, SensorContract

FEATURES = ("z", "h", "zh")
_ADAPT = "put the sensor's scans through navrep_data.observations.ScanAdapter"
# The farthest range that a scan may hold, as a multiple of range_max: beyond it is another unit. Halls and maps are
# wider than a contract (ranges are cut there); 1000 m are less than a scan in millimetres has in any room.
_FAR = 40.0

ArrayT = TypeVar("ArrayT", NDArray[Any], Tensor)


class Policy:
    """A controller with all that it needs to drive robots from scans.

    Parameters
    ----------
    network : ActorCritic
        The controller, or an end-to-end network.
    features : str or None
        What the controller takes: ``"z"`` (z and robot state), ``"h"`` (robot state and h), ``"zh"`` (z, robot state
        and h, in this order); None = the observation itself (end-to-end).
    lidar : str or None
        ``"rings"`` or ``"1d"``; None for a controller whose encoder is not known: it has no :meth:`act`.
    vae : VAE, optional
        Encoder; that of `world_model` if left out.
    world_model : WorldModel, optional
        Memory, for ``"h"`` and ``"zh"``.
    name : str
        Full name, kept with results.
    context : str, optional
        What the memory keeps, see :meth:`navrep_data.models.WorldModel.stream`; as the released model of that kind if
        left out.
    inference : str
        ``"deterministic"``: no dropout, z = mu, LSTM state zero at the start. ``"as_released"``: the memory runs as in
        the original, where dropout stayed on, z was sampled and the joint LSTM started anew from a random state at
        every step.
    seed : int
        Of the noise of ``"as_released"``; it starts again with every ``reset(batch_size=...)``.
    dtype : str
        ``"bfloat16"`` rounds the encoder: about twice the speed where the processor has bf16.
    compile : bool
        Compile the encoder by torch.compile.
    device : str
        Where the networks run.
    encoder : nn.Module, optional
        Observations to z, made beforehand from `vae` instead of by `dtype` and `compile`, such as a
        :class:`navrep_data.models.QuantizedEncoder`.
    sensor : SensorContract
        What scans must be.
    ranges : str
        ``"contract"``: ranges beyond the sensor's `range_max` are cut there, as in training. ``"as_released"``: they
        reach the network as they are, as in the authors' test, where a map is up to 109 m wide.
    robot : RobotContract
        What the policy was trained on; the robot of ``navrep-train`` if left out. For another robot see
        :meth:`for_robot`.

    Attributes
    ----------
    trained_on : RobotContract
        The robot of its training.
    robot : RobotContract
        The robot that it drives: an action of 1 is this robot's ``max_speed``.

    Raises
    ------
    ConfigError
        If a setting cannot be used or a part is missing.
    CheckpointError
        If the parts do not fit each other.

    Notes
    -----
    Released controllers saturate: nearly all actions are exactly -1 or 1 on both axes (bang-bang control).
    """

    def __init__(
        self,
        network: ActorCritic,
        features: str | None,
        lidar: str | None,
        vae: VAE | None = None,
        world_model: WorldModel | None = None,
        *,
        name: str = "",
        context: str | None = None,
        inference: str = "deterministic",
        seed: int = 0,
        dtype: str = "float32",
        compile: bool = False,
        device: str | torch.device = "cpu",
        encoder: torch.nn.Module | None = None,
        sensor: SensorContract | None = None,
        ranges: str = "contract",
        robot: RobotContract | None = None,
    ) -> None:
        if inference not in INFERENCE:
            raise ConfigError(f"inference is {inference!r}, expected one of: {', '.join(INFERENCE)}.")
        if ranges not in RANGES:
            raise ConfigError(f"ranges is {ranges!r}, expected one of: {', '.join(RANGES)}.")
        if features is not None and features not in FEATURES:
            raise ConfigError(f"features is {features!r}, expected one of: {', '.join(FEATURES)}, or None.")
        self.name = name
        self.features, self.lidar = features, lidar
        self.sensor = SensorContract() if sensor is None else sensor
        self.ranges = ranges
        self.trained_on = self.robot = RobotContract() if robot is None else robot
        self._scale: RobotScale | None = None
        self.device = torch.device(device)
        self.context, self.inference, self.seed = context, inference, seed
        self.network = network.to(self.device).eval()
        self.vae = world_model.vae if vae is None and world_model is not None else vae
        self.world_model = world_model if features in ("h", "zh") else None
        self._check_parts()
        for part in (self.vae, self.world_model):
            if part is not None:
                part.to(self.device).eval()
        self._encoder = self._make_encoder(dtype, compile) if encoder is None else encoder
        self._stream: Stream | None = None
        self._noise: Noise | None = None
        # what the memory is fed one step later, once the action taken is known
        self._waiting: tuple[Tensor, Tensor, Tensor] | None = None
        self._fresh = torch.zeros(0, dtype=torch.bool, device=self.device)
        self._last = torch.zeros(0, ACTION_SIZE, dtype=torch.float32, device=self.device)

    def _check_parts(self) -> None:
        if self.lidar is None:
            return
        if self.features is None:
            n = math.prod(OBSERVATION_SHAPES[self.lidar]) + ROBOT_STATE_SIZE
        else:
            if self.vae is None:
                raise ConfigError(f"{self._who()} takes {self.features}, expected a VAE or a world model for it.")
            if self.features != "z" and self.world_model is None:
                raise ConfigError(f"{self._who()} takes {self.features}, expected a world model for its memory.")
            z = self.vae.config.z_size if "z" in self.features else 0
            h = self.world_model.h_size if self.world_model is not None else 0
            n = z + ROBOT_STATE_SIZE + h
            if self.vae.config.lidar != self.lidar:
                raise CheckpointError(f"{self._who()} is for {self.lidar}, its V for {self.vae.config.lidar}.")
        if n != self.n_inputs:
            raise CheckpointError(
                f"{self._who()} has {self.n_inputs} inputs, expected {n} from its parts: they do not belong together."
            )

    def _who(self) -> str:
        return self.name or "This policy"

    @building()
    def _make_encoder(self, dtype: str, compile: bool) -> torch.nn.Module | None:
        if isinstance(self.network, EndToEnd):
            net = self.network
            return FrozenEncoder(net.encoder, net.fc, net.config.lidar, dtype, compile).to(self.device)
        return None if self.vae is None else FrozenEncoder.of(self.vae, dtype, compile).to(self.device)

    @property
    def n_inputs(self) -> int:
        """Numbers that the controller takes."""
        if isinstance(self.network, EndToEnd):
            return math.prod(OBSERVATION_SHAPES[self.network.config.lidar]) + ROBOT_STATE_SIZE
        first = self.network.pi[0]
        assert isinstance(first, torch.nn.Linear)
        return first.in_features

    def __repr__(self) -> str:
        return f"Policy({self.name!r}, lidar={self.lidar!r}, features={self.features!r}, inference={self.inference!r})"

    def content_hash(self) -> str:
        """Return a SHA-256 over the weights of all parts and what they are run with.

        Two policies with the same one choose the same actions, up to rounding: datasets name their policy by it.
        """
        digest = hashlib.sha256(repr((
            self.features, self.lidar, self.context, self.inference, self.seed, self.ranges, self.robot,
            self.trained_on,
        )).encode())  # fmt: skip
        for part in (self.network, self.vae, self.world_model):
            for name, tensor in sorted(part.state_dict().items()) if part is not None else ():
                digest.update(f"{name} {tuple(tensor.shape)}".encode() + tensor.cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()

    def for_robot(self, max_speed: float | None = None, radius: float | None = None) -> Policy:
        """Return this policy for a robot of another top speed or size, with a memory of its own.

        Parameters
        ----------
        max_speed : float, optional
            Velocity along x and y that an action of 1 stands for on that robot [m/s]; that of ``robot`` if left
            out, which is as trained until it has been set once.
        radius : float, optional
            Radius of its footprint [m]; that of ``robot`` if left out.

        Returns
        -------
        Policy
            Takes that robot's scans, robot states and executed velocities in metres and m/s, and returns shares of that
            robot's top speed. The networks are shared.

        Raises
        ------
        ConfigError
            If a number is not positive, or ranges are as the authors fed them: their software scales nothing.

        Notes
        -----
        :class:`navrep_data.observations.RobotScale` says what is scaled and how; docs/experiments.md how that was
        chosen.
        """
        robot = RobotContract(
            self.robot.max_speed if max_speed is None else max_speed,
            self.robot.radius if radius is None else radius,
        )
        if robot != self.trained_on and self.ranges == "as_released":
            raise ConfigError(
                f"{self._who()} takes ranges as the authors fed them, which are not scaled: load it without ranges=."
            )
        other = copy.copy(self)
        other.robot = robot
        other._scale = None if robot == self.trained_on else RobotScale(self.trained_on, robot, self.sensor.range_max)
        other._stream, other._noise, other._waiting = None, None, None
        other._fresh = torch.zeros(0, dtype=torch.bool, device=self.device)
        other._last = torch.zeros(0, ACTION_SIZE, dtype=torch.float32, device=self.device)
        return other

    # --- episodes ----------------------------------------------------------------------------------------------

    def reset(
        self, batch_size: int | None = None, mask: ArrayLike | Tensor | None = None, seed: int | None = None
    ) -> None:
        """Start episodes.

        Parameters
        ----------
        batch_size : int, optional
            Start this many, all anew; 1 or as many as before if left out.
        mask : ndarray of shape (B,), bool, optional
            Instead: restart only the episodes where it is true.
        seed : int, optional
            Of the noise of ``inference="as_released"`` from here on.

        Raises
        ------
        PolicyError
            If the batch size or the mask cannot be used.
        """
        if seed is not None:
            self.seed = seed
        n = len(self._last)
        if mask is not None:
            chosen = torch.as_tensor(mask if isinstance(mask, Tensor) else np.array(mask), device=self.device)
            if batch_size is not None or chosen.shape != (n,) or chosen.dtype != torch.bool:
                raise PolicyError(
                    f"mask has shape {tuple(chosen.shape)} and {chosen.dtype}, expected bool of shape ({n},), and no "
                    "batch_size beside it: one entry per robot."
                )
            self._last[chosen] = 0.0
            self._fresh[chosen] = True
            if self._stream is not None:
                self._stream.reset(chosen)
            return
        n = check_whole("batch_size", max(1, n) if batch_size is None else batch_size, 1, error=PolicyError)
        self._last = torch.zeros(n, ACTION_SIZE, dtype=torch.float32, device=self.device)
        self._waiting, self._fresh = None, torch.ones(n, dtype=torch.bool, device=self.device)
        self._noise = Noise.seeded(self.seed, self.device) if self.inference == "as_released" else None
        if self.world_model is not None:
            self._stream = self.world_model.stream(n, self.context, self._noise)

    def observe(self, executed_action: ArrayLike | Tensor) -> None:
        """Tell what the robots did since the last :meth:`encode`, where it is not what :meth:`act` asked for.

        Parameters
        ----------
        executed_action : ndarray of shape (B, 2) or (B, 3) [m/s, m/s, rad/s]
            Body velocities of the robot as its base received them, after clipping and limits: what the ``action``
            column of datasets holds. Memories are fed them at the next step, for another robot in the proportions of
            the one they were trained on.

        Raises
        ------
        PolicyError
            If the shape does not fit.
        """
        action = _tensor(executed_action, self.device)
        if action.ndim != 2 or len(action) != len(self._last) or action.shape[1] not in (2, ACTION_SIZE):
            raise PolicyError(
                f"executed_action has shape {tuple(action.shape)}, expected ({len(self._last)}, 3) or "
                f"({len(self._last)}, 2): one row per robot since reset(batch_size=...)."
            )
        if self._scale is not None:
            action = torch.cat([action[:, :2] * self._scale.factor, action[:, 2:]], dim=1)
        self._last = torch.nn.functional.pad(action, (0, ACTION_SIZE - action.shape[1])).clone()

    # --- steps -------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def act(self, scan: ArrayT, robot_state: ArrayT) -> ArrayT:
        """Return the action of each robot and remember it for the next step.

        Parameters
        ----------
        scan : ndarray or Tensor of shape (B, 1080) [m]
            Ranges; ray 0 straight ahead, anticlockwise, 25 or more where a ray hits nothing, +inf included: that is
            25, whatever `ranges` is.
        robot_state : ndarray or Tensor of shape (B, 5) [m, m, m/s, m/s, rad/s]
            Goal x, y, velocity x, y and turn rate, robot frame.

        Returns
        -------
        ndarray or Tensor of shape (B, 3), float32
            Velocity x, y in [-1, 1] as shares of ``robot.max_speed``, and 0; of the kind that `scan` is.

        Raises
        ------
        ArrayError
            If the arrays are not what the model takes, or a range is NaN, negative, or farther than a scan in metres
            has it (1000 m); another sensor's scans go through ScanAdapter.
        PolicyError
            If the batch size is not that of :meth:`reset`, or the policy has no encoder.
        """
        features, state = self._features(scan, robot_state)
        if isinstance(self.network, EndToEnd) and self._encoder is not None:
            obs = features.reshape(len(features), *OBSERVATION_SHAPES[self.network.config.lidar])
            inputs = torch.cat([self._encoder(obs), state], dim=1)
            mean = self.network.mean(self.network.pi(inputs))
        else:
            mean = self.network.mean(self.network.pi(features))
        chosen = torch.nn.functional.pad(self.network.command(mean), (0, ACTION_SIZE - mean.shape[1]))
        self._last = chosen * self.trained_on.max_speed
        action: ArrayT = _like(chosen, scan)
        return action

    __call__ = act

    @torch.no_grad()
    def encode(self, scan: ArrayT, robot_state: ArrayT) -> ArrayT:
        """Return what the controller takes, and take one step in the memory, as :meth:`act` does.

        Parameters
        ----------
        scan, robot_state
            As for :meth:`act`.

        Returns
        -------
        ndarray or Tensor of shape (B, F), float32
            [z, robot state], [robot state, h] or [z, robot state, h]; end-to-end: [observation, robot state].

        Raises
        ------
        ArrayError, PolicyError
            As :meth:`act`.

        Notes
        -----
        Call either this or :meth:`act` once per step. After this one, say by :meth:`observe` what the robots then did;
        otherwise the memory is fed the action before.
        """
        features, state = self._features(scan, robot_state)
        if self.features is None:
            features = torch.cat([features, state], dim=1) if isinstance(self.network, EndToEnd) else features
        result: ArrayT = _like(features, scan)
        return result

    @torch.no_grad()
    def look(self, scan: NDArray[Any], robot_state: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return what the controller takes but for the memory, of any number of rows, without a step in it.

        Parameters
        ----------
        scan, robot_state
            As for :meth:`act`, with any number of rows.

        Returns
        -------
        features : ndarray of shape (B, F)
            [z, robot state] or [robot state]; end-to-end: [observation, robot state].
        robot_state : ndarray of shape (B, 5)
            As given, float32, for another robot in the proportions of the one of training.

        Raises
        ------
        ArrayError, PolicyError
            As :meth:`act`.
        """
        ranges, state = self._fitted(*self._checked(scan, robot_state))
        assert self.lidar is not None
        if self.features == "h":
            return state.cpu().numpy(), state.cpu().numpy()
        obs = observation_from_scan(ranges, self.lidar, self.features is not None).to(self.device)
        if self.features is None:
            front = torch.tensor(fill_blind(ranges), device=self.device) if self.lidar == "1d" else obs.flatten(1)
        else:
            assert self._encoder is not None
            front = self._encoder(obs)
        return torch.cat([front, state], dim=1).cpu().numpy(), state.cpu().numpy()

    @torch.no_grad()
    def controller(self, features: ArrayT) -> tuple[ArrayT, ArrayT]:
        """Return the mean action, unclipped, (B, 2) and the value (B,) of features (B, F).

        Raises
        ------
        ArrayError
            If the features have another size.
        """
        inputs = _tensor(features, self.device)
        if inputs.ndim != 2 or inputs.shape[1] != self.n_inputs:
            raise ArrayError(
                f"features has shape {tuple(inputs.shape)}, expected (B, {self.n_inputs}): what encode() returns."
            )
        mean, value = self.network(inputs)
        return _like(mean, features), _like(value, features)

    def _features(self, scan: NDArray[Any] | Tensor, robot_state: NDArray[Any] | Tensor) -> tuple[Tensor, Tensor]:
        """Return features on the device, and the robot state; end-to-end networks get both apart."""
        ranges, state = self._of_now(scan, robot_state)
        if self._stream is not None and not self._stream.listens() and self.features == "h":
            # all contexts are full: nothing that the lidar sees changes h any more
            ignored = state.new_zeros(len(state), self.world_model.z_size if self.world_model is not None else 0)
            return torch.cat([state, self._remember(ignored, ignored, state[:, :2])], dim=1), state
        assert self.lidar is not None
        if self.features is None:
            if self.lidar == "1d":
                obs = torch.tensor(fill_blind(ranges), device="cpu")
            else:
                obs = observation_from_scan(ranges, "rings", zero_first_bin=False).flatten(1)
            obs = obs.to(self.device)
            return (obs if isinstance(self.network, EndToEnd) else torch.cat([obs, state], dim=1)), state
        obs = observation_from_scan(ranges, self.lidar).to(self.device)
        assert self.vae is not None
        assert self._encoder is not None
        mu = logvar = self._encoder(obs)
        if self._stream is None:
            return torch.cat([mu, state], dim=1), state
        if self._noise is not None:
            mu, logvar = self.vae.distribution(obs)
        h = self._remember(mu, logvar, state[:, :2])
        return torch.cat([mu, state, h] if self.features == "zh" else [state, h], dim=1), state

    def _remember(self, mu: Tensor, logvar: Tensor, goal: Tensor) -> Tensor:
        """Take one step in the memory and return h (B, H).

        Notes
        -----
        A memory that is fed the action chosen at a row cannot take this row in before the policy has acted. Its h is
        that after the row before, which has predicted this one, and zero on an episode's first row.
        """
        assert self._stream is not None
        assert self.world_model is not None
        if self.world_model.config.action_alignment == "leading":
            return self._stream.step(mu, logvar, goal, self._last)
        before, self._waiting = self._waiting, (mu.clone(), logvar.clone(), goal.clone())
        if before is None:
            h = mu.new_zeros(len(mu), self.world_model.h_size)
        else:
            h = self._stream.step(*before, self._last)
            if bool(self._fresh.any()):  # what was fed for them belongs to the episode before
                self._stream.reset(self._fresh)
                h[self._fresh] = 0.0
        self._fresh[:] = False
        return h

    def _checked(self, scan: NDArray[Any] | Tensor, robot_state: NDArray[Any] | Tensor) -> tuple[NDArray[Any], Tensor]:
        """Return ranges on the host, with "nothing hit" in place of inf, and robot state on the device, or raise."""
        if self.lidar is None:
            raise PolicyError(f"{self._who()} cannot see: its encoder is not known. Use controller(features).")
        ranges = scan.detach().cpu().numpy() if isinstance(scan, Tensor) else np.asarray(scan)
        n_rays = self.sensor.n_rays
        if ranges.ndim != 2 or ranges.shape[1] != n_rays or not np.issubdtype(ranges.dtype, np.floating):
            raise ArrayError(
                f"scan has shape {ranges.shape} and dtype {ranges.dtype}, expected (B, {n_rays}) floating metres over "
                f"a full turn: {_ADAPT}, or stored millimetres through metres_from_millimetres."
            )
        if len(ranges) == 0:
            raise ArrayError(f"scan has shape {ranges.shape}, expected at least one row.")
        free, far = self.sensor.range_max, _FAR * self.sensor.range_max
        if ranges.max() == np.inf:
            ranges = np.where(np.isposinf(ranges), ranges.dtype.type(free), ranges)
        low, high = ranges.min(), ranges.max()
        if not (low >= 0.0 and high <= far):  # also true of NaN
            raise ArrayError(
                f"scan holds values from {low} to {high}, expected 0 to {far:g} m, with {free:g} or more (or inf) "
                f"where nothing is hit: {_ADAPT}."
            )
        state = _tensor(robot_state, self.device)
        if state.shape != (len(ranges), ROBOT_STATE_SIZE) or not bool(torch.isfinite(state).all()):
            raise ArrayError(
                f"robot_state has shape {tuple(state.shape)}, expected ({len(ranges)}, {ROBOT_STATE_SIZE}) finite "
                "numbers: goal x, y, vx, vy, omega."
            )
        return ranges, state

    def _of_now(
        self, scan: NDArray[Any] | Tensor, robot_state: NDArray[Any] | Tensor
    ) -> tuple[NDArray[np.float32], Tensor]:
        """Return a step of all robots as the networks know it, or raise."""
        ranges, state = self._checked(scan, robot_state)
        if len(self._last) == 0 or (self.world_model is None and len(self._last) != len(ranges)):
            self.reset(batch_size=len(ranges))
        if len(self._last) != len(ranges):
            raise PolicyError(
                f"scan has {len(ranges)} rows, expected {len(self._last)}: call reset(batch_size={len(ranges)}) before "
                "the first step of another number of robots."
            )
        return self._fitted(ranges, state)

    def _fitted(self, ranges: NDArray[Any], state: Tensor) -> tuple[NDArray[np.float32], Tensor]:
        """Return ranges and robot states as the networks know them: within the contract, of the robot of training."""
        ranges = np.ascontiguousarray(ranges, dtype=np.float32)
        if self.ranges == "contract":
            ranges = np.minimum(ranges, np.float32(self.sensor.range_max))
        if self._scale is None:
            return ranges, state
        factors = torch.full((ROBOT_STATE_SIZE,), self._scale.factor, device=state.device)
        factors[-1] = 1.0  # time is not scaled, so turn rates are not
        return self._scale.ranges(ranges), state * factors

    def check_sensor(self, sensor: SensorContract) -> None:
        """Raise unless scans of `sensor` are what the policy takes; ranges may be longer, they are cut.

        Raises
        ------
        ConfigError
            If rays, angles or time step differ, or the range is shorter.
        """
        mine, other = self.sensor.to_dict(), sensor.to_dict()
        for field, value in mine.items():
            if field == "range_max" and other[field] > value:
                continue
            if abs(float(value) - float(other[field])) > 1e-4:
                raise ConfigError(f"{self._who()} takes scans with {field} = {value}, got {other[field]}: {_ADAPT}.")


def _tensor(value: Any, device: torch.device) -> Tensor:
    """Return a float32 tensor that shares no memory with an ndarray, which may be read-only."""
    host = torch.device("cpu")  # whatever the default device is
    source = value.detach() if isinstance(value, Tensor) else torch.tensor(np.asarray(value, np.float32), device=host)
    return source.to(device, torch.float32)


def _like(value: Tensor, example: Any) -> Any:
    """Return `value` as a tensor on the device of `example`, or as an ndarray where that is none."""
    if isinstance(example, Tensor):
        return value.to(example.device)
    return value.cpu().numpy()
