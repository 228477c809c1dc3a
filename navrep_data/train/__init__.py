"""Training of V, M, joint model, transformer and controllers: plain PyTorch on the package's datasets."""

from __future__ import annotations

from navrep_data.train.controller_recipe import (
    ControllerRecipe,
    default_controller_recipe,
    original_controller_recipe,
)
from navrep_data.train.controllers import TrainedController, train_controller
from navrep_data.train.recipe import Recipe, default_recipe, original_recipe, read_recipe, shipped_recipes
from navrep_data.train.world_models import Trained, train_world_model

__all__ = [
    "ControllerRecipe",
    "Recipe",
    "Trained",
    "TrainedController",
    "default_controller_recipe",
    "default_recipe",
    "original_controller_recipe",
    "original_recipe",
    "read_recipe",
    "shipped_recipes",
    "train_controller",
    "train_world_model",
]
