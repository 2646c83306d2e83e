"""The Python programs of the README and the quickstart, read out of them and run on a tiny data set."""

import re
from pathlib import Path

import pytest
from launcher import ROOT, run_script
from test_scripts import TINY

PROGRAMS = [
    (name, program)
    for name in ("README.md", "docs/quickstart.md")
    for program in re.findall(r"```python\n(.*?)```", (ROOT / name).read_text(encoding="utf-8"), flags=re.DOTALL)
]


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a data set and a run where the programs look for them."""
    cwd = tmp_path_factory.mktemp("readme")
    size = ("num_frames=4", "num_val=1", "num_test=1", "resolution=24")
    made = run_script("make_dataset", "scene=walker", *size, "out=data/mutant", cwd=cwd)
    assert made.returncode == 0, made.stderr
    data = ("data=blender", "data.root=data/mutant", "data.resolution=24")
    done = run_script("train", "experiment=fast", *data, *TINY[4:], "out_dir=runs/mutant", cwd=cwd)
    assert done.returncode == 0, done.stderr
    return cwd


@pytest.mark.parametrize(("name", "program"), PROGRAMS, ids=[f"{name}-{k}" for k, (name, _) in enumerate(PROGRAMS)])
def test_a_documented_program_runs(name: str, program: str, work: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(work)
    short = re.sub(r"max_seconds=\d+", "max_seconds=0.5", program)
    short = short.replace("400", "24")  # pixels
    exec(compile(short, name, "exec"), {})  # noqa: S102
    assert len(program.splitlines()) <= 15


def test_the_readme_trains_and_loads_a_run() -> None:
    readme = "".join(program for name, program in PROGRAMS if name == "README.md")
    assert all(name in readme for name in ("load_dataset(", "fit_box(", ".fit(", "load_run(", "render_image("))
