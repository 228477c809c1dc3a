"""A tiny dataset, and one thread, as where trainings are tested."""

from train.conftest import dataset, one_thread

__all__ = ["dataset", "one_thread"]
