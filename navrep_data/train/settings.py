"""What can be set in a training by ``--set NAME=VALUE``: names, units, meanings, and other libraries' names."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

from navrep_data.errors import ConfigError, did_you_mean
from navrep_data.schema import SensorContract
from navrep_data.sim import SimConfig, make_config

STAGES = ("v", "m", "joint", "transformer", "controller", "e2e")
_PPO, _MODELS = ("controller", "e2e"), ("v", "m", "joint", "transformer")
_WHOLE = ("joint", "transformer")
_SEQUENCES = ("m", *_WHOLE)
_ENCODERS = ("v", *_WHOLE)
# not --set: flags of their own decide them
_FLAGS = ("model", "features", "lidar", "original", "env", "sim")

DESCRIPTIONS: dict[str, tuple[tuple[str, ...], str, str]] = {
    "steps": (STAGES, "steps", "optimiser steps; of all worlds together for controller and e2e"),
    "batch": (STAGES, "rows", "windows (v: frames, PPO: rows) per gradient step"),
    "seed": (STAGES, "", "of weights, order, noise and worlds"),
    "lr": (STAGES, "", "learning rate"),
    "precision": (STAGES, "", "float32 or bfloat16; of the frozen encoder int8, too"),
    "validate_every": (STAGES, "steps", "between validations"),
    "z_size": (_MODELS, "", "numbers of z"),
    "h_size": (("m", "joint"), "", "cells of the LSTM"),
    "n_blocks": (("transformer",), "", "blocks of the transformer"),
    "action_alignment": (_SEQUENCES, "", "taken or leading: which action a row is fed"),
    "residual": (_WHOLE, "", "predict changes of z and goal"),
    "micro_batch": (_MODELS, "rows", "windows per forward and backward pass"),
    "window": (_SEQUENCES, "rows", "rows that are predicted from"),
    "stride": (_SEQUENCES, "rows", "between the starts of two windows"),
    "lr_end": (_MODELS, "", "where the learning rate ends"),
    "schedule": (_MODELS, "", "cosine, tokens, exponential or constant"),
    "warmup": (_MODELS, "steps", "of a linear rise of the learning rate"),
    "weight_decay": (_MODELS, "", "AdamW's; 0: Adam"),
    "decay": (_MODELS, "", "what decays: matrices, authors (all but biases) or none"),
    "beta1": (_MODELS, "", "Adam's"),
    "beta2": (_MODELS, "", "Adam's"),
    "epsilon": (_MODELS, "", "Adam's"),
    "clip_norm": (_MODELS, "", "largest norm of the gradient; 0: none"),
    "clip_value": (_MODELS, "", "largest gradient of a weight; 0: none"),
    "reconstruction": (_ENCODERS, "", "cross_entropy, squared or squared_sum"),
    "kl_weight": (_ENCODERS, "", "weight of the KL divergence"),
    "kl_floor": (_ENCODERS, "", "below which it costs no more"),
    "kl_warmup": (_ENCODERS, "steps", "over which its weight rises from 0"),
    "goal_scale": (_SEQUENCES, "m", "what errors of goals are divided by"),
    "dropout": (_WHOLE, "", "in the memory"),
    "reconstruct_share": (_WHOLE, "", "share of rows whose reconstruction is compared"),
    "predict_share": (_WHOLE, "", "share of rows whose prediction is compared"),
    "dream_share": (_SEQUENCES, "", "share of rows that the memory is fed as it expected them itself"),
    "freeze_v": (_WHOLE, "", "keep V as --init gives it"),
    "restart_factor": (("m",), "", "weight of rows before an episode's last in the restart loss"),
    "ranges_weight": (_ENCODERS, "", "weight of how well z tells how near things are"),
    "people_weight": (_ENCODERS, "", "weight of how well z tells how near people are (true positions)"),
    "validate_batches": (_MODELS, "batches", "per validation"),
    "save_every": (_MODELS, "steps", "between checkpoints"),
    "picture_every": (_MODELS, "steps", "between pictures"),
    "worlds": (_PPO, "", "worlds stepped at once"),
    "rollout": (_PPO, "steps", "of each world between two updates"),
    "epochs": (_PPO, "", "passes over a rollout"),
    "gamma": (_PPO, "", "discount"),
    "gae_lambda": (_PPO, "", "of the advantage estimate"),
    "clip_range": (_PPO, "", "PPO's"),
    "entropy": (_PPO, "", "weight of the entropy"),
    "value_weight": (_PPO, "", "weight of the value's error"),
    "max_grad_norm": (_PPO, "", "largest norm of the gradient"),
    "target_kl": (_PPO, "", "an update stops where the policy moved farther; 0: never"),
    "least_std": (_PPO, "", "least width of the action's distribution"),
    "hidden": (_PPO, "", "units per layer"),
    "max_speed": (_PPO, "m/s", "longest velocity commanded; 0: [-1, 1] on each axis"),
    "reward_scale": (_PPO, "", "factor on rewards"),
    "progress": (_PPO, "1/m", "further reward per metre nearer to the goal, before the factor"),
    "timeouts_end": (_PPO, "", "nothing is expected after a timeout; otherwise timeouts are truncations"),
    "easy_start": (_PPO, "", "adaptive curriculum: start without humans and obstacles"),
    "context": (("controller",), "", "what a memory keeps: newest-32, oldest-32, carried-state"),
    "refit": (("controller",), "", "fit the controller of --init to the codes of another V first"),
    # worlds
    "physics": (_PPO, "", "consistent or original"),
    "crossing": (_PPO, "", "circle or square: how humans start"),
    "humans": (_PPO, "", "mean number of humans; an episode has 0.5 to 1.5 times as many"),
    "obstacles": (_PPO, "", "most squares, and most walls, in an episode"),
    "rendering": (_PPO, "", "legs, trunk or ellipse: what the lidar sees of a human"),
    "polygon_scale": (_PPO, "", "factor on obstacle sizes"),
    "time_limit": (_PPO, "s", "longest episode"),
    "world": (_PPO, "", "polygons, empty or map"),
    "maps": (_PPO, "", "names or folders, with commas between them"),
    "scenarios": (_PPO, "", "names, with commas between them"),
    "human_policy": (_PPO, "", "orca, static, constant-velocity or planned"),
    "robots": (_PPO, "", "1: controllers drive one robot"),
    "drive": (_PPO, "", "holonomic, or differential: the robot turns to the velocity commanded and goes forward"),
    "inertia": (_PPO, "", "none or limited: acceleration and jerk have limits"),
    "max_velocity": (_PPO, "m/s, m/s, rad/s", "what full commands mean; three numbers with commas between them"),
    "robot_acceleration": (_PPO, "m/s2, m/s2, rad/s2", "three limits, for inertia=limited"),
    "robot_jerk": (_PPO, "m/s3, m/s3, rad/s3", "three limits, for inertia=limited"),
    "on_collision": (_PPO, "", "end or damage"),
    "max_damage": (_PPO, "m/s", "at which the episode ends"),
    "goal_radius": (_PPO, "m", "how near to the goal counts; none: the robot's radius"),
    "curriculum": (_PPO, "", "constant or adaptive"),
    "scan_noise": (_PPO, "m", "standard deviation of ranges"),
    "scan_dropout": (_PPO, "", "probability that a ray reads 0"),
    "sensor.n_rays": (_PPO, "", "rays; other sensors than the networks' go through ScanAdapter"),
    "sensor.angle_min": (_PPO, "rad", "of ray 0, anticlockwise"),
    "sensor.angle_increment": (_PPO, "rad", "between rays"),
    "sensor.range_max": (_PPO, "m", "what a ray reads that hits nothing"),
    "sensor.dt": (_PPO, "s", "time step"),
}
"""Name -> (stages that use it, unit, one line)."""

USUAL = {
    "learning_rate": "lr", "batch_size": "batch", "mini_batch_size": "batch", "minibatch_size": "batch",
    "n_steps": "rollout", "num_steps": "rollout", "rollout_length": "rollout", "n_envs": "worlds",
    "num_envs": "worlds", "num_worlds": "worlds", "n_epochs": "epochs", "num_epochs": "epochs",
    "ent_coef": "entropy", "entropy_coef": "entropy", "vf_coef": "value_weight", "value_coef": "value_weight",
    "discount": "gamma", "lam": "gae_lambda", "lambda": "gae_lambda", "gae": "gae_lambda", "clip_eps": "clip_range",
    "clip_param": "clip_range", "total_timesteps": "steps", "max_steps": "steps", "iterations": "steps",
    "grad_clip": "clip_norm", "gradient_clip": "clip_norm", "adam_eps": "epsilon", "eps": "epsilon",
    "wd": "weight_decay", "l2": "weight_decay", "beta": "kl_weight", "kl_coef": "kl_weight",
    "latent_dim": "z_size", "latent_size": "z_size",
    "z_dim": "z_size", "hidden_size": "h_size", "hidden_dim": "h_size", "n_layer": "n_blocks", "n_layers": "n_blocks",
    "num_layers": "n_blocks", "sequence_length": "window", "seq_len": "window", "block_size": "window",
    "accumulate": "micro_batch", "net_arch": "hidden", "n_hidden": "hidden", "random_seed": "seed",
    "dtype": "precision",
    "eval_freq": "validate_every", "save_freq": "save_every", "dt": "sensor.dt", "n_rays": "sensor.n_rays",
    "range_max": "sensor.range_max", "map": "maps", "noise": "scan_noise", "dropout_rate": "dropout",
    "n_humans": "humans", "people": "humans", "max_episode_steps": "time_limit", "warmup_steps": "warmup",
}  # fmt: skip
"""Names that other libraries have -> ours; where a stage lacks ours, see :data:`_OTHERWISE`."""
_OTHERWISE = {
    "clip_norm": "max_grad_norm", "max_grad_norm": "clip_norm", "epochs": "steps", "h_size": "hidden",
    "hidden": "h_size", "window": "rollout",
}  # fmt: skip


def sim_settings() -> dict[str, Any]:
    """Return what can be set of the worlds of a controller's training beside `physics`, with SimConfig's defaults."""
    names = [field.name for field in dataclasses.fields(SimConfig) if field.name not in ("env", "physics", "sensor")]
    values = {name: getattr(SimConfig(), name) for name in names}
    return values | {f"sensor.{name}": value for name, value in SensorContract().to_dict().items()}


def environment_of_settings(env: str, physics: str, sim: Mapping[str, Any]) -> SimConfig:
    """Return the config of an environment with settings as :func:`sim_settings` names them."""
    changes = {name: value for name, value in sim.items() if not name.startswith("sensor.")}
    config = make_config(env, physics=physics, **changes)
    sensor = {n.removeprefix("sensor."): value for n, value in sim.items() if n.startswith("sensor.")}
    return config.replace(sensor=dataclasses.replace(config.sensor, **sensor)) if sensor else config


def hint(name: str, known: Iterable[str]) -> str:
    """Return what an unknown setting may have been meant for: a usual name of it, or the nearest in spelling."""
    names = list(known)
    ours = USUAL.get(name.lower().replace("-", "_"), name)
    for candidate in (ours, _OTHERWISE.get(ours, "")):
        if candidate in names:
            return f" Did you mean {candidate!r}?"
    # a usual name is known to mean something that the stage lacks: what is spelt like it means something else
    return did_you_mean(name, names) if ours == name else ""


def parse(pairs: Iterable[str], known: Mapping[str, Any], stage: str) -> dict[str, Any]:
    """Return NAME=VALUE pairs as values of the kinds that `known` has.

    Raises
    ------
    ConfigError
        If a name is unknown or a value of another kind.
    """
    found: dict[str, Any] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals or name not in known:
            raise ConfigError(
                f"--set {pair!r} is no setting.{hint(name, known)} Expected NAME=VALUE; list all: navrep-data "
                f"train {stage} --list-settings"
            )
        try:
            found[name] = _value(name, text, known[name])
        except (KeyError, ValueError):
            kind = {tuple: "list with commas", type(None): "number or none"}.get(type(known[name]))
            raise ConfigError(
                f"--set {name}={text} is no {kind or type(known[name]).__name__}, as {name} is."
            ) from None
    return found


def _value(name: str, text: str, example: Any) -> Any:
    if isinstance(example, bool):
        return {"true": True, "false": False}[text.lower()]
    if isinstance(example, tuple):
        parts = [part.strip() for part in text.split(",") if part.strip()]
        return [float(part) for part in parts] if example and isinstance(example[0], float) else parts
    if example is None:
        return None if text.lower() == "none" else float(text)
    return type(example)(text)


def list_settings(stage: str) -> list[str]:
    """Return a line for every setting of a stage: name, default, unit, meaning; 1D's default where it is another."""
    from navrep_data.train import default_controller_recipe, default_recipe

    if stage in _PPO:
        features = "e2e" if stage == "e2e" else "z"
        recipes: list[Any] = [default_controller_recipe(features, lidar) for lidar in ("rings", "1d")]
        both = [{**sim_settings(), **_env_defaults(recipe.env), **recipe.to_dict()} for recipe in recipes]
    else:
        both = [default_recipe(stage, lidar).to_dict() for lidar in ("rings", "1d")]
    lines = [f"{'--set':<22} {'default':<26} {'unit':<18} meaning"]
    for name, (stages, unit, text) in DESCRIPTIONS.items():
        if stage not in stages or name in _FLAGS:
            continue
        rings, ranges = (_shown(values[name]) for values in both)
        default = rings if rings == ranges else f"{rings} (1d: {ranges})"
        lines.append(f"{name:<22} {default:<26} {unit or '-':<18} {text}")
    return lines


def _env_defaults(env: str) -> dict[str, Any]:
    config = make_config(env)
    sensor = {f"sensor.{name}": value for name, value in config.sensor.to_dict().items()}
    return {**{name: getattr(config, name) for name in sim_settings() if "." not in name}, **sensor}


def _shown(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ",".join(map(_shown, value)) or "-"
    if isinstance(value, bool):
        return str(value).lower()
    return "none" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
