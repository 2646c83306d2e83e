"""Parts from outside of this repository: a deformation, a field and a loss, read out of the how-to about them."""

import re
from pathlib import Path

import pytest
import yaml
from launcher import ROOT, run_script
from test_scripts import TINY

# Where the how-to's blocks go: by the class that each defines.
MODULES = {"Wobble": "deformations.py", "Blob": "fields.py", "OpacityLoss": "losses.py"}
YAML = {
    "deformation/wobble.yaml": "_target_: wobble.deformations.Wobble\nfrequency: 2.0\n",
    "field/blob.yaml": "_target_: wobble.fields.Blob\n",
    "trainer/losses/opacity.yaml": "opacity:\n  _target_: wobble.losses.OpacityLoss\n  weight: 0.1\n",
}
PARTS = (
    "experiment=fast", "data=synthetic", "scene=walker", *TINY, "deformation=wobble", "field=blob", "renderer=default",
    "trainer/losses=[rgb,opacity]", "out_dir=run",
)  # fmt: skip


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    cwd = tmp_path_factory.mktemp("outside")
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs/howto/extend.md").read_text(), flags=re.DOTALL)
    (cwd / "wobble").mkdir()
    (cwd / "wobble" / "__init__.py").touch()
    for name, file in MODULES.items():
        (block,) = (block for block in blocks if f"class {name}(" in block)
        (cwd / "wobble" / file).write_text(block)
    for name, text in YAML.items():
        path = cwd / "wobble" / "conf" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return cwd


@pytest.fixture(scope="module")
def search(work: Path) -> str:
    return f"hydra.searchpath=[file://{work}/wobble/conf]"


@pytest.fixture(scope="module")
def trained(work: Path, search: str) -> Path:
    done = run_script("train", search, *PARTS, cwd=work, environment={"PYTHONPATH": str(work)})
    assert done.returncode == 0, done.stderr
    return work


def test_a_model_of_outside_parts_is_trained(trained: Path) -> None:
    config = yaml.safe_load((trained / "run" / "config.yaml").read_text())
    field = config["renderer"]["field"]
    assert field["deformation"] == {"_target_": "wobble.deformations.Wobble", "frequency": 2.0}
    assert field["canonical"] == {"_target_": "wobble.fields.Blob"}
    assert '"opacity": ' in (trained / "run" / "log.jsonl").read_text()


def test_its_run_is_rendered_by_whoever_trusts_the_package(trained: Path, search: str) -> None:
    arguments = ("run=run", "path=fixed", "num_frames=1", "format=png")
    for trusted, code in (("", 2), ("other", 2), ("wobble", 0)):
        environment = {"PYTHONPATH": str(trained), "DNERF_PLUGINS": trusted}
        done = run_script("render", search, *arguments, cwd=trained, environment=environment)
        assert done.returncode == code, done.stderr
        lines = done.stderr.strip().splitlines()
        if code:
            assert len(lines) == 1, done.stderr
            assert lines[0].startswith("error: run/config.yaml: ")
            assert "DNERF_PLUGINS=wobble trusts it" in lines[0]


def test_its_run_is_continued_by_whoever_trusts_the_package(trained: Path, search: str) -> None:
    arguments = (search, *PARTS, "resume=true", "trainer.num_steps=4")
    for trusted, code in (("", 2), ("wobble", 0)):
        environment = {"PYTHONPATH": str(trained), "DNERF_PLUGINS": trusted}
        done = run_script("train", *arguments, cwd=trained, environment=environment)
        assert done.returncode == code, done.stderr
        assert ("DNERF_PLUGINS=wobble" in done.stderr) == (code == 2)
