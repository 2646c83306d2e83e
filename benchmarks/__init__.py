"""Benchmarks: suites by name, each returning tables and plots, and one writer for their reports.

A new suite is one module here with `run(settings)`; `scripts/benchmark.py suite=<module>` then finds it.
"""

from benchmarks.machine import describe_machine
from benchmarks.report import write_report
from benchmarks.suite import Plot, Series, Settings, SuiteResult, Table, run_suite, suite_names
from benchmarks.timing import num_threads

__all__ = [
    "Plot", "Series", "Settings", "SuiteResult", "Table", "describe_machine", "num_threads", "run_suite",
    "suite_names", "write_report",
]  # fmt: skip
