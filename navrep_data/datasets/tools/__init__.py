"""Tools on datasets: each reads datasets and makes a new folder, which appears whole or not at all."""

from navrep_data.datasets.tools.edits import filter, merge, split
from navrep_data.datasets.tools.exports import ExportResult, export, original_arrays
from navrep_data.datasets.tools.pictures import sample
from navrep_data.datasets.tools.stats import stats

__all__ = ["ExportResult", "export", "filter", "merge", "original_arrays", "sample", "split", "stats"]
