"""The floors of the design: a module imports only from lower floors or its own package."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "dnerf"

FLOORS = {
    # 0: knows nothing of rendering. `checks` and `files` serve every floor and need none.
    "allocator": 0,
    "checks": 0,
    "encodings": 0,
    "files": 0,
    "fixed_size": 0,
    "geometry": 0,
    "graphs": 0,
    "provenance": 0,
    "rays": 0,
    "stopping": 0,
    "trajectories": 0,
    # 1: one ray at a time.
    "backgrounds": 1,
    "cameras": 1,
    "compositing": 1,
    "kernels": 1,
    "mlp": 1,
    "quadrature": 1,
    "deformations": 2,
    "fields": 3,
    "fast_bodies": 3,
    "frame_graphs": 4,
    "samplers": 4,
    "tracing": 4,
    "renderer": 5,
    "scenes": 5,
    "data": 6,
    "flow_losses": 6,
    "limits": 6,
    "losses": 6,
    "metrics": 6,
    "missing_matter": 6,
    "motion": 6,
    "motion_losses": 6,
    "optimizers": 6,
    "plots": 6,
    "protocols": 6,
    "records": 6,
    "recovery": 6,
    "time_window": 6,
    "visualisation": 6,
    # 7: whole runs.
    "body_search": 7,
    "box_check": 7,
    "checkpoints": 7,
    "consistency": 7,
    "distributed": 7,
    "error_map": 7,
    "evaluation": 7,
    "logs": 7,
    "motion_search": 7,
    "report": 7,
    "run_state": 7,
    "seen_matter": 7,
    "silhouettes": 7,
    "sequences": 7,
    "sightings": 7,
    "steps": 7,
    "temporal_evaluation": 7,
    "tracks": 7,
    "training": 7,
    "training_loop": 7,
    "video": 7,
    "viewer": 7,
    # 8: looks at all of them from outside.
    "benchmarks": 8,
}

# Imports within a floor, each deliberate: `checks` is the ground of floor 0, compositing is built on its kernels,
# losses about motion are losses, logs record what training, evaluation and video make.
WITHIN_A_FLOOR = {
    ("compositing", "kernels"),
    ("compositing", "quadrature"),
    ("encodings", "checks"),
    ("encodings", "geometry"),
    ("flow_losses", "motion_losses"),
    ("geometry", "checks"),
    ("logs", "evaluation"),
    ("logs", "training"),
    ("logs", "video"),
    ("mlp", "kernels"),
    ("motion_losses", "losses"),
    ("motion_search", "seen_matter"),
    ("tracks", "video"),
    ("rays", "checks"),
    ("rays", "fixed_size"),
    ("sequences", "logs"),
    ("sequences", "video"),
    ("temporal_evaluation", "evaluation"),
    ("run_state", "checkpoints"),
    ("training", "body_search"),
    ("body_search", "error_map"),
    ("body_search", "sightings"),
    ("sightings", "error_map"),
    ("training", "box_check"),
    ("training", "distributed"),
    ("training", "error_map"),
    ("training", "silhouettes"),
    ("training", "run_state"),
    ("training", "steps"),
    ("training", "training_loop"),
    ("training_loop", "distributed"),
    ("training_loop", "run_state"),
    ("training_loop", "steps"),
}

ONLY_SCRIPTS_KNOW = {"hydra", "omegaconf"}


def is_type_checking(node: ast.stmt) -> bool:
    """Whether a statement is `if TYPE_CHECKING:`, whose imports never run."""
    return isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING")


def statements(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """Every statement that can run, functions' bodies included."""
    for node in body:
        if isinstance(node, ast.If) and is_type_checking(node):
            yield from statements(node.orelse)
            continue
        yield node
        for block in ("body", "orelse", "finalbody", "handlers", "cases"):
            for child in getattr(node, block, []):
                yield from statements([child] if isinstance(child, ast.stmt) else child.body)


def imported_modules(source: str, module: str, is_package: bool = False) -> set[str]:
    """Full names of the modules that the source of `module` imports, relative imports resolved."""
    names = set()
    for node in statements(ast.parse(source).body):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parts = module.split(".")
            base = parts[: len(parts) - node.level + is_package] if node.level else []
            origin = ".".join([*base, *([node.module] if node.module else [])])
            # `from dnerf import rays` names a module, `from dnerf.rays import Rays` does not.
            names |= {f"{origin}.{alias.name}" for alias in node.names} if origin == "dnerf" else {origin}
    return names


def units(names: set[str]) -> set[str]:
    """The parts of the package (a module or subpackage directly below `dnerf`) among module names."""
    return {name.split(".")[1] for name in names if name.startswith("dnerf.")} - {"__version__"}


def violations(source: str, module: str, is_package: bool = False) -> list[str]:
    """What is wrong with the imports of one module, one line each."""
    names = imported_modules(source, module, is_package)
    problems = [f"{module} imports {name}" for name in names if name.split(".")[0] in ONLY_SCRIPTS_KNOW]
    if module == "dnerf":
        return problems + [f"dnerf imports its own part {unit}" for unit in units(names)]
    own = module.split(".")[1]
    if own not in FLOORS:
        return [*problems, f"{module} has no floor: give dnerf.{own} one in tests/test_floors.py"]
    for unit in sorted(units(names) - {own}):
        lower = unit in FLOORS and FLOORS[unit] < FLOORS[own]
        if not lower and (own, unit) not in WITHIN_A_FLOOR:
            problems.append(f"{module} (floor {FLOORS[own]}) imports {unit} (floor {FLOORS.get(unit)})")
    return problems


def package_files() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@pytest.mark.parametrize("path", package_files(), ids=module_name)
def test_imports_go_down(path: Path) -> None:
    assert violations(path.read_text(), module_name(path), path.name == "__init__.py") == []


def test_imports_within_a_floor_stay_within_one_floor_and_are_all_used() -> None:
    found = set()
    for path in package_files():
        name = module_name(path)
        imported = imported_modules(path.read_text(), name, path.name == "__init__.py")
        found |= {(name.split(".")[1], unit) for unit in units(imported) if name != "dnerf"}
    assert found >= WITHIN_A_FLOOR
    assert all(FLOORS[above] == FLOORS[below] for above, below in WITHIN_A_FLOOR)


@pytest.mark.parametrize(
    ("source", "module"),
    [
        ("from dnerf.renderer import Renderer", "dnerf.rays"),
        ("from dnerf import renderer", "dnerf.fields.nerf"),
        ("import dnerf.training", "dnerf.renderer"),
        ("from ..samplers import base", "dnerf.fields.nerf"),
        ("from .compositing import composite", "dnerf.rays"),
        ("def late():\n    from dnerf.samplers import Sampler", "dnerf.fields.base"),
        ("try:\n    pass\nexcept ValueError:\n    import hydra", "dnerf.training"),
        ("from omegaconf import DictConfig", "dnerf.training"),
        ("import torch", "dnerf.a_new_module"),
        ("from dnerf.evaluation import evaluate", "dnerf.training"),
        ("if TYPE_CHECKING:\n    pass\nelse:\n    import dnerf.samplers", "dnerf.rays"),
        ("from dnerf import rays", "dnerf"),
    ],
)
def test_an_import_that_breaks_the_floors_is_found(source: str, module: str) -> None:
    assert len(violations(source, module)) == 1


@pytest.mark.parametrize(
    ("source", "module"),
    [
        ("from dnerf.rays import Rays", "dnerf.fields.nerf"),
        ("from .base import RadianceField", "dnerf.fields.nerf"),
        ("from dnerf.fields.base import RadianceField", "dnerf.fields.nerf"),
        ("if TYPE_CHECKING:\n    from dnerf.compositing import FieldOutput", "dnerf.rays"),
        ("from dnerf import __version__", "dnerf.training"),
    ],
)
def test_an_import_that_obeys_the_floors_is_let_through(source: str, module: str) -> None:
    assert violations(source, module) == []
