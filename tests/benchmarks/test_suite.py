"""Finding and running suites."""

import sys
from types import ModuleType

import pytest

from benchmarks import Settings, SuiteResult, Table, run_suite, suite, suite_names


@pytest.fixture
def module(monkeypatch):
    """A suite of the test's own, as a new file in the package would be."""
    module = ModuleType("benchmarks.made_up", "What it measures.")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(suite, "suite_names", lambda: ["made_up"])
    return module


def test_suites_are_the_modules_with_a_run_function():
    names = suite_names()
    assert "kernels" in names
    assert not {"suite", "report", "timing", "machine", "plotting"} & set(names)


def test_plain_rows_become_a_report(module):
    module.run = lambda settings: [{"solver": "midpoint", "error": 1e-3}, {"solver": "rk4", "error": 1e-6}]
    result = run_suite("made_up", Settings())
    assert result.title == "Made up"
    assert result.summary == "What it measures."
    assert result.tables == [
        Table("made_up", [{"solver": "midpoint", "error": 1e-3}, {"solver": "rk4", "error": 1e-6}])
    ]


def test_a_suite_gets_its_settings_and_its_result_is_kept(module):
    module.run = lambda settings: SuiteResult("t", str(settings.seed), [])
    assert run_suite("made_up", Settings(seed=7)).summary == "7"


def test_unknown_suite_is_refused_by_name():
    with pytest.raises(ValueError, match=r"suite must be one of .*kernels.*; got 'speed'"):
        run_suite("speed", Settings())


def test_suites_of_whole_models_need_someone_who_builds_them():
    with pytest.raises(ValueError, match="build must be given"):
        Settings().parts("experiment=fast")
    assert Settings(build=lambda overrides: {"overrides": overrides}).parts("a", "b") == {"overrides": ("a", "b")}
