"""From a seed to a dataset on disk, and back: prove a dataset by making some of it again."""

from navrep_data.generate.driver import GenerateResult, generate
from navrep_data.generate.parts import merge_manifest
from navrep_data.generate.regenerate import RegenerateReport, SequenceComparison, regenerate

__all__ = ["GenerateResult", "RegenerateReport", "SequenceComparison", "generate", "merge_manifest", "regenerate"]
