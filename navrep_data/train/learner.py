"""What PPO trains: the network of a recipe, the policy around it, and the learner."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from navrep_data.errors import CheckpointError, ConfigError
from navrep_data.models import Controller, ControllerConfig, EndToEnd, EndToEndConfig, QuantizedEncoder
from navrep_data.models.controllers import N_ACTIONS
from navrep_data.models.observation import observation_from_scan
from navrep_data.models.quantized import can_quantize
from navrep_data.models.world_model import WorldModel
from navrep_data.schema import ACTION_SIZE, ROBOT_STATE_SIZE
from navrep_data.sim import Simulator
from navrep_data.train.controller_recipe import ControllerRecipe, environment
from navrep_data.train.encode import vae_of
from navrep_data.train.ppo import GroupedPPO
from navrep_data.train.ppo_policy import FastExtractor
from navrep_data.train.worlds import TrainingWorlds, WorldGroups
from navrep_data.zoo.policy import Policy
from navrep_data.zoo.sb3 import BoundedPolicy
from navrep_data.zoo.sb3_worlds import eyes

_CODES = 0.2
_WORTH_A_GROUP = 64
_CALIBRATION, _CALIBRATION_STEPS = 512, 25


def make_network(recipe: ControllerRecipe, model: Any) -> Controller | EndToEnd:
    """Return a new controller for a recipe and a world model (or V).

    Raises
    ------
    ConfigError
        If the model lacks what the features need, or is for another lidar.
    """
    squash = "clip" if recipe.original else "tanh"
    if recipe.features == "e2e":
        return EndToEnd(EndToEndConfig(recipe.lidar, n_hidden=recipe.hidden, squash=squash, max_speed=recipe.max_speed))
    vae = vae_of(model, "The world model")
    if vae.config.lidar != recipe.lidar:
        raise ConfigError(f"The world model reads {vae.config.lidar}, expected {recipe.lidar}: set --lidar to match.")
    n = ROBOT_STATE_SIZE + (vae.config.z_size if "z" in recipe.features else 0)
    if "h" in recipe.features:
        if not isinstance(model, WorldModel):
            raise ConfigError(
                f"Features {recipe.features} need a memory, expected a world model, not a {type(model).__name__}: "
                "take --features z, or name a joint, transformer or modular model."
            )
        n += model.h_size
    network = Controller(ControllerConfig(n, recipe.hidden, squash, recipe.max_speed))
    if not recipe.original:
        scale_inputs(network, vae.config.z_size if "z" in recipe.features else 0)
    return network


@torch.no_grad()
def scale_inputs(network: Controller, n_before: int) -> None:
    """Start with small weights for the codes: there are many of them, and the way to the goal is what comes first."""
    for perceptron in (network.pi, network.vf):
        first = perceptron[0]
        assert isinstance(first, nn.Linear)
        first.weight[:, :n_before] *= _CODES


def make_encoder(recipe: ControllerRecipe, model: Any) -> QuantizedEncoder | None:
    """Return the encoder to train through where the recipe asks for 8 bits, None where the policy makes its own.

    Notes
    -----
    It is calibrated on worlds of the training environment, always the same, so that a resume has the same encoder.
    """
    if recipe.features == "e2e" or recipe.precision != "int8" or not can_quantize():
        return None
    config = environment(recipe)
    see, simulator = eyes(config), Simulator(config, _CALIBRATION, seed=0)
    simulator.reset()
    draw = np.random.default_rng(0)
    for _ in range(_CALIBRATION_STEPS):
        commands = np.zeros((_CALIBRATION, ACTION_SIZE))
        commands[:, :N_ACTIONS] = draw.uniform(-1.0, 1.0, (_CALIBRATION, N_ACTIONS))
        _, events = simulator.step(commands)
        simulator.reset(events != 0)
    return QuantizedEncoder(
        vae_of(model, "The world model"), observation_from_scan(see(simulator.observe()[0]), recipe.lidar)
    )


def _floats(recipe: ControllerRecipe) -> str:
    """Return what is computed with where 8 bits cannot be."""
    return "bfloat16" if recipe.precision == "int8" else recipe.precision


def make_policy(
    recipe: ControllerRecipe, network: Controller | EndToEnd, model: Any, name: str = "",
    encoder: QuantizedEncoder | None = None,
) -> Policy:  # fmt: skip
    """Return the policy that a controller makes with its world model, encoding by `encoder` where there is one.

    Raises
    ------
    CheckpointError, ConfigError
        If they do not fit.
    """
    dtype = _floats(recipe)
    if recipe.features == "e2e":
        return Policy(network, None, recipe.lidar, name=name, dtype=dtype)
    world_model = model if isinstance(model, WorldModel) and "h" in recipe.features else None
    context = None if world_model is None or world_model.default_context == "carried-state" else recipe.context
    return Policy(
        network, recipe.features, recipe.lidar, vae_of(model, name), world_model, name=name, context=context,
        dtype=dtype, encoder=encoder,
    )  # fmt: skip


def make_worlds(
    recipe: ControllerRecipe, network: Controller | EndToEnd, model: Any, encoder: QuantizedEncoder | None, seed: int
) -> WorldGroups:
    """Return the worlds to train in, in as many groups as torch has threads, if they are large enough to be worth it.

    Every group has a policy of its own, since that keeps the memories of its worlds.
    """

    def make(n_worlds: int, first_sequence: int) -> TrainingWorlds:
        return TrainingWorlds(
            environment(recipe), make_policy(recipe, network, model, "", encoder), n_worlds, seed=seed,
            first_sequence=first_sequence, max_speed=network.config.max_speed, reward_scale=recipe.reward_scale,
            progress=recipe.progress, truncate=not recipe.timeouts_end,
        )  # fmt: skip

    n_groups = max(1, min(torch.get_num_threads(), recipe.worlds // _WORTH_A_GROUP))
    return WorldGroups(make, recipe.worlds, n_groups)


def make_ppo(recipe: ControllerRecipe, worlds: WorldGroups, network: Controller | EndToEnd, device: str) -> PPO:
    """Return the learner, with the network's weights."""
    kwargs: dict[str, Any] = {
        "net_arch": {"pi": [network.config.n_hidden] * 2, "vf": [network.config.n_hidden] * 2},
        "activation_fn": nn.Tanh,
        "optimizer_kwargs": {"eps": 1e-5, "fused": True},
    }
    if isinstance(network, EndToEnd):
        kwargs |= {
            "activation_fn": nn.ReLU,
            "features_extractor_class": FastExtractor,
            "features_extractor_kwargs": {
                "lidar": recipe.lidar,
                "precision": _floats(recipe),
                "scaled": not recipe.original,
            },
        }
    kind: type[ActorCriticPolicy] = ActorCriticPolicy
    algorithm = PPO
    if network.config.squash != "clip":
        kind, kwargs["least_std"] = BoundedPolicy, recipe.least_std
        algorithm = GroupedPPO
    return algorithm(
        kind, worlds, learning_rate=recipe.lr, n_steps=recipe.rollout, batch_size=recipe.batch, n_epochs=recipe.epochs,
        gamma=recipe.gamma, gae_lambda=recipe.gae_lambda, clip_range=recipe.clip_range,
        clip_range_vf=recipe.clip_range if recipe.original else None, ent_coef=recipe.entropy,
        vf_coef=recipe.value_weight, max_grad_norm=recipe.max_grad_norm,
        target_kl=recipe.target_kl if recipe.target_kl > 0 else None, policy_kwargs=kwargs, seed=recipe.seed,
        device=device,
    )  # fmt: skip


def network_of(init: Policy, recipe: ControllerRecipe, model: Any) -> Controller | EndToEnd:
    """Return the network to go on from, after checking that it takes what the recipe feeds."""
    if not isinstance(init, Policy):
        raise CheckpointError(
            f"--init is a {type(init).__name__}, expected a policy such as transformer_1d_z.released."
        )
    wanted = make_network(recipe, model)
    network = init.network
    if type(network) is not type(wanted) or init.features != (None if recipe.features == "e2e" else recipe.features):
        raise CheckpointError(
            f"--init {init.name} takes {init.features or 'observations'}, expected {recipe.features}: they do not fit."
        )
    assert isinstance(network, Controller | EndToEnd)
    first, other = network.pi[0], wanted.pi[0]
    assert isinstance(first, nn.Linear)
    assert isinstance(other, nn.Linear)
    if init.lidar != recipe.lidar or first.in_features != other.in_features:
        raise CheckpointError(
            f"--init {init.name} has {first.in_features} inputs for {init.lidar}, expected {other.in_features} for "
            f"{recipe.lidar}: name the world model that it was trained with, or --set refit=true."
        )
    return network
