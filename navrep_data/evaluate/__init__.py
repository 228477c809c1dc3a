"""Measuring: world-model errors and benchmark suites."""
