"""Measuring: benchmark suites of numbered episodes with metrics, tables and figures; world-model errors."""

from navrep_data.evaluate.driver import Benchmark, benchmark, redraw
from navrep_data.evaluate.metrics import METRICS, Metric
from navrep_data.evaluate.policies import BASELINES
from navrep_data.evaluate.results import Results
from navrep_data.evaluate.scores import score, summary
from navrep_data.evaluate.statistics import bootstrap, wilson
from navrep_data.evaluate.suites import Scenario, Suite, get_suite, suite_names

__all__ = [
    "BASELINES",
    "METRICS",
    "Benchmark",
    "Metric",
    "Results",
    "Scenario",
    "Suite",
    "benchmark",
    "bootstrap",
    "get_suite",
    "redraw",
    "score",
    "suite_names",
    "summary",
    "wilson",
]
