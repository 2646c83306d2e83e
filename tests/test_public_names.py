"""What `import dnerf` gives: names that are there, are loaded when used, and cost nothing before."""

import subprocess
import sys
from importlib import import_module

import pytest

import dnerf


def test_importing_the_package_loads_nothing_else() -> None:
    program = "import sys, dnerf; dir(dnerf); print([m for m in sys.modules if m in ('torch', 'numpy', 'hydra')])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", [name for name in dnerf.__all__ if name != "__version__"])
def test_a_name_is_what_its_module_defines(name: str) -> None:
    value = getattr(dnerf, name)
    assert value is getattr(import_module(value.__module__), name)
    assert name in dir(dnerf)


def test_the_names_are_few_and_the_others_are_missed() -> None:
    assert len(dnerf.__all__) <= 30
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        _ = dnerf.Nothing
