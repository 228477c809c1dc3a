"""Measuring: benchmark suites of numbered episodes with metrics, tables and figures; world-model errors."""

from navrep_data.evaluate.driver import Benchmark, benchmark, redraw
from navrep_data.evaluate.metrics import METRICS, RATIOS, Contacts, Metric
from navrep_data.evaluate.results import Results
from navrep_data.evaluate.scores import compare, score, summary
from navrep_data.evaluate.statistics import bootstrap, bootstrap_ratio, mcnemar, wilson
from navrep_data.evaluate.suites import Suite, SuiteScenario, get_suite, suite_names

__all__ = [
    "METRICS",
    "RATIOS",
    "Benchmark",
    "Contacts",
    "Metric",
    "Results",
    "Suite",
    "SuiteScenario",
    "benchmark",
    "bootstrap",
    "bootstrap_ratio",
    "compare",
    "get_suite",
    "mcnemar",
    "redraw",
    "score",
    "suite_names",
    "summary",
    "wilson",
]
