"""What a benchmark suite is: a module with a function `run` that returns tables and plots, found by its name."""

import importlib
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

from dnerf.core.checks import check_choice

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Table:
    """Rows of a report.

    Args:
        title: what the rows show.
        rows: one mapping per row; the columns are the keys in the order in which they first come, units included
            ("median_ms"). Values are strings, numbers, booleans or None.
        note: what a reader must know, in one or a few sentences.
        name: of the files; made from the title if empty.
    """

    title: str
    rows: Sequence[Row]
    note: str = ""
    name: str = ""


@dataclass(frozen=True)
class Series:
    """One labelled line (or cloud of points) of a plot.

    Args:
        label: written beside the line's end.
        x: values along the horizontal axis.
        y: values along the vertical axis.
        low: lower ends of the spread of y, or None.
        high: upper ends.
        x_low: lower ends of the spread of x, or None.
        x_high: upper ends.
        notes: text beside single points, or None.
        style: "line", "dashed", "points" or "guide" (thin, dashed, grey: a theoretical order, a limit).
        color: index of the palette, for series that belong together; None gives every series its own.
    """

    label: str
    x: Sequence[float]
    y: Sequence[float]
    low: Sequence[float] | None = None
    high: Sequence[float] | None = None
    x_low: Sequence[float] | None = None
    x_high: Sequence[float] | None = None
    notes: Sequence[str] | None = None
    style: str = "line"
    color: int | None = None


@dataclass(frozen=True)
class Plot:
    """One image of a report.

    Args:
        name: of the file, without suffix.
        title: what is shown.
        x_label: with unit.
        y_label: with unit.
        series: at least one.
        x_log: whether the horizontal axis is logarithmic.
        y_log: whether the vertical axis is.
        note: one sentence on how to read it.
    """

    name: str
    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    x_log: bool = True
    y_log: bool = True
    note: str = ""


@dataclass(frozen=True)
class BarPlot:
    """Horizontal bars, one group for each category.

    Args:
        name: of the file, without suffix.
        title: what is shown.
        x_label: of the bars' length, with unit.
        categories: labels of the groups, from top to bottom.
        values: lengths by label of the bars, one per category; NaN for none.
        note: one sentence on how to read it.
        log: whether lengths are on a logarithmic axis.
    """

    name: str
    title: str
    x_label: str
    categories: Sequence[str]
    values: Mapping[str, Sequence[float]]
    note: str = ""
    log: bool = False


@dataclass(frozen=True)
class SuiteResult:
    """What a suite found.

    Args:
        title: of the report.
        summary: what was measured and how, for a reader who knows nothing of it.
        tables: at least one.
        plots: any number.
        findings: sentences with figures, each true of the tables above it.
    """

    title: str
    summary: str
    tables: Sequence[Table]
    plots: Sequence[Plot | BarPlot] = ()
    findings: Sequence[str] = ()


@dataclass(frozen=True)
class Settings:
    """What every suite is told.

    Args:
        quick: sizes that take less than a minute, to see that everything works; figures mean little.
        seed: of all random numbers.
        device: "cpu" or "cuda".
        work_dir: a folder for runs and other files that nobody keeps.
        train_command: how a training run is started in a process of its own, overrides to be appended.
        build: config overrides of a training run -> its parts by name ("renderer", "trainer", "data", "chunk"), built.
        load: folder of a finished run, overrides of its config -> "renderer", "data" and "chunk", read.
        options: further values of this suite's section of the config.
    """

    quick: bool = False
    seed: int = 0
    device: str = "cpu"
    work_dir: Path = Path("runs/benchmark")
    train_command: Sequence[str] = ()
    build: Callable[[Sequence[str]], Mapping[str, Any]] | None = None
    load: Callable[[str, Sequence[str]], Mapping[str, Any]] | None = None
    options: Mapping[str, Any] = field(default_factory=dict)

    def parts(self, *overrides: str) -> Mapping[str, Any]:
        """Renderer, trainer and data of a config.

        Raises:
            ValueError: if whoever made the settings cannot build configs.
        """
        if self.build is None:
            raise ValueError("build must be given to the settings of a suite that measures whole models, got None")
        return self.build(overrides)

    def finished(self, run: str, overrides: Sequence[str] = ()) -> Mapping[str, Any]:
        """Renderer, data and chunk of a finished run, in which some settings may be others.

        Raises:
            ValueError: if whoever made the settings cannot read runs, or for a folder that is none.
        """
        if self.load is None:
            raise ValueError("load must be given to the settings of a suite that measures finished runs, got None")
        return self.load(run, overrides)


def suite_names() -> list[str]:
    """Names of all suites: the modules of this package that define `run`."""
    package = importlib.import_module(__package__)
    found = [module.name for module in pkgutil.iter_modules(package.__path__)]
    return sorted(name for name in found if callable(getattr(_module(name), "run", None)))


def run_suite(name: str, settings: Settings) -> SuiteResult:
    """Run a suite by name.

    Its `run(settings)` returns a `SuiteResult`, or just rows (a sequence of mappings), which become one table.

    Raises:
        ValueError: for a name that is no suite.
    """
    check_choice("suite", name, suite_names())
    module = _module(name)
    result = module.run(settings)
    if isinstance(result, SuiteResult):
        return result
    return SuiteResult(name.replace("_", " ").capitalize(), (module.__doc__ or "").strip(), [Table(name, list(result))])


def _module(name: str) -> ModuleType:
    return importlib.import_module(f"{__package__}.{name}")
