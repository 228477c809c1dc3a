"""The networks of the paper as torch modules: V, M, joint, transformer, controllers, end-to-end.

:mod:`navrep_data.models.checkpoint` is the only way they are saved and loaded.
"""

from __future__ import annotations

from navrep_data.models import checkpoint
from navrep_data.models.config import (
    OBSERVATION_SHAPES,
    ControllerConfig,
    EndToEndConfig,
    JointConfig,
    MemoryConfig,
    ModelConfig,
    ModularConfig,
    TransformerConfig,
    VAEConfig,
)
from navrep_data.models.controllers import ActorCritic, Controller, EndToEnd
from navrep_data.models.encoder import FrozenEncoder
from navrep_data.models.joint import JointWorldModel
from navrep_data.models.modular import MDNRNN, Mixture, ModularWorldModel
from navrep_data.models.noise import Noise
from navrep_data.models.observation import observation_from_rings, observation_from_scan
from navrep_data.models.quantized import QuantizedEncoder
from navrep_data.models.transformer import TransformerWorldModel
from navrep_data.models.vae import VAE, n_parameters
from navrep_data.models.world_model import Output, Prediction, Stream, WorldModel

__all__ = [
    "MDNRNN",
    "OBSERVATION_SHAPES",
    "VAE",
    "ActorCritic",
    "Controller",
    "ControllerConfig",
    "EndToEnd",
    "EndToEndConfig",
    "FrozenEncoder",
    "JointConfig",
    "JointWorldModel",
    "MemoryConfig",
    "Mixture",
    "ModelConfig",
    "ModularConfig",
    "ModularWorldModel",
    "Noise",
    "Output",
    "Prediction",
    "QuantizedEncoder",
    "Stream",
    "TransformerConfig",
    "TransformerWorldModel",
    "VAEConfig",
    "WorldModel",
    "checkpoint",
    "n_parameters",
    "observation_from_rings",
    "observation_from_scan",
]
