"""From a seed to a dataset on disk."""

from navrep_data.generate.driver import GenerateResult, generate

__all__ = ["GenerateResult", "generate"]
