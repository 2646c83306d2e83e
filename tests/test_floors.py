"""The floors of the house: a module imports from its own package, its floor and those below, and never in a circle."""

import ast
from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FLOORS = (
    {"core", "nn", "kernels"}, {"deformations"}, {"fields"}, {"samplers"}, {"rendering", "scenes"},
    {"data", "losses", "motion"}, {"training", "evaluation", "visualization", "planning", "capturing", "meshing"},
)  # fmt: skip
OUTSIDE = {"benchmarks", "scripts", "tests"}  # know the package, which knows nothing of them
LOOSE = {"__init__", "__main__", "_version"}  # modules of the package itself
ONLY_SCRIPTS_KNOW = {"hydra", "omegaconf"}

FLOOR_OF = {package: number for number, floor in enumerate(FLOORS) for package in floor}


def statements(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """Every statement that can run, functions' bodies included."""
    for node in body:
        if isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING"):
            yield from statements(node.orelse)
            continue
        yield node
        for block in ("body", "orelse", "finalbody", "handlers", "cases"):
            for child in getattr(node, block, []):
                yield from statements([child] if isinstance(child, ast.stmt) else child.body)


def imported_names(source: str, module: str, is_package: bool = False) -> set[str]:
    """Full names of what the source of `module` imports, relative imports resolved: modules, or names in modules."""
    names = set()
    for node in statements(ast.parse(source).body):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parts = module.split(".")
            base = parts[: len(parts) - node.level + is_package] if node.level else []
            origin = ".".join([*base, *([node.module] if node.module else [])])
            names |= {f"{origin}.{alias.name}" for alias in node.names}
    return names


def package_of(name: str) -> str | None:
    """The package directly below `dnerf` that a name belongs to; None for one of another library, or `dnerf`'s own."""
    parts = name.split(".")
    return parts[1] if parts[0] == "dnerf" and len(parts) > 1 and parts[1] in FLOOR_OF else None


def violations(source: str, module: str, is_package: bool = False) -> list[str]:
    """What is wrong with the imports of one module, one line each."""
    names = sorted(imported_names(source, module, is_package))
    problems = [f"{module} imports {name}" for name in names if name.split(".")[0] in ONLY_SCRIPTS_KNOW | OUTSIDE]
    own = FLOOR_OF.get(package_of(module), len(FLOORS))
    higher = [name for name in names if FLOOR_OF.get(package_of(name), -1) > own]
    return problems + [f"{module} (floor {own}) imports {name}, of a higher one" for name in higher]


def sources(root: Path = ROOT) -> dict[str, tuple[str, bool]]:
    """Source of every module of the package by name, and whether it is a package's `__init__`."""
    found = {}
    for path in sorted((root / "dnerf").rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        is_package = parts[-1] == "__init__"
        found[".".join(parts[:-1] if is_package else parts)] = (path.read_text(), is_package)
    return found


def module_graph(modules: Mapping[str, tuple[str, bool]]) -> dict[str, set[str]]:
    """By module, those it imports: `from dnerf.fields import GridField` imports `dnerf.fields`."""
    graph = {}
    for module, (source, is_package) in modules.items():
        names = imported_names(source, module, is_package)
        targets = {name if name in modules else name.rpartition(".")[0] for name in names}
        graph[module] = {target for target in targets if target in modules and target != module}
    return graph


def package_graph(graph: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """By package above the ground floor, the others there that its modules import."""
    found: dict[str, set[str]] = {package: set() for package, floor in FLOOR_OF.items() if floor > 0}
    for module, targets in graph.items():
        if (own := package_of(module)) in found:
            found[own] |= {package_of(target) for target in targets} & found.keys() - {own}
    return found


def cycle(graph: Mapping[str, set[str]]) -> list[str]:
    """Modules or packages that import each other in a circle; none if there is no circle."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


MODULES = sources()


@pytest.mark.parametrize("module", MODULES)
def test_imports_go_down(module: str) -> None:
    assert violations(MODULES[module][0], module, MODULES[module][1]) == []


def test_modules_and_packages_do_not_import_each_other_in_a_circle() -> None:
    graph = module_graph(MODULES)
    assert cycle(graph) == []
    assert cycle(package_graph(graph)) == []


def test_every_module_lives_in_a_package_that_has_a_floor() -> None:
    parts = {module.split(".")[1] for module in MODULES if module != "dnerf"}
    assert parts - LOOSE == set(FLOOR_OF)


BREAKS = [
    ("from dnerf.rendering.renderer import Renderer", "dnerf.core.rays"),
    ("from dnerf import rendering", "dnerf.fields.nerf"),
    ("import dnerf.training.trainer", "dnerf.rendering.renderer"),
    ("from ..samplers import base", "dnerf.fields.nerf"),
    ("def late():\n    from dnerf.samplers import Sampler", "dnerf.fields.base"),
    ("try:\n    pass\nexcept ValueError:\n    import hydra", "dnerf.training.trainer"),
    ("from omegaconf import DictConfig", "dnerf.training.trainer"),
    ("from benchmarks.timing import timed", "dnerf.evaluation.report"),
    ("if TYPE_CHECKING:\n    pass\nelse:\n    import dnerf.samplers", "dnerf.core.rays"),
    ("import hydra", "dnerf"),
]
OBEYS = [
    ("from dnerf.core.rays import Rays", "dnerf.fields.nerf"),
    ("from .base import RadianceField", "dnerf.fields.nerf"),
    ("from dnerf.kernels import march", "dnerf.core.rays"),
    ("from dnerf.evaluation.scores import evaluate", "dnerf.training.trainer"),
    ("if TYPE_CHECKING:\n    from dnerf.training.trainer import Trainer", "dnerf.core.rays"),
    ("from dnerf import __version__", "dnerf.training.trainer"),
    ("from dnerf.training.trainer import Trainer", "dnerf"),
]


@pytest.mark.parametrize(("source", "module", "count"), [(*x, 1) for x in BREAKS] + [(*x, 0) for x in OBEYS])
def test_an_import_that_breaks_the_floors_is_found_and_one_that_obeys_is_let_through(
    source: str, module: str, count: int
) -> None:
    assert len(violations(source, module)) == count


def test_circles_are_found() -> None:
    modules = {
        "dnerf.core.a": ("from dnerf.kernels import b", False), "dnerf.kernels": ("", True),
        "dnerf.kernels.b": ("from .c import x", False), "dnerf.kernels.c": ("import dnerf.core.a", False),
        "dnerf.rendering.d": ("from dnerf.scenes.e import x", False), "dnerf.scenes.e": ("", False),
        "dnerf.scenes.f": ("from dnerf.rendering.d import y", False),
    }  # fmt: skip
    graph = module_graph(modules)
    assert set(cycle(graph)) == {"dnerf.core.a", "dnerf.kernels.b", "dnerf.kernels.c"}
    assert set(cycle(package_graph(graph))) == {"rendering", "scenes"}
    del modules["dnerf.kernels.c"], modules["dnerf.scenes.f"]
    graph = module_graph(modules)
    assert cycle(graph) == cycle(package_graph(graph)) == []
