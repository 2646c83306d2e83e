"""Objects from configs, and runs that are loaded: which classes may be named, and where an error is."""

import json
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import pytest
import torch

from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.data import SyntheticData
from dnerf.deformations import IdentityDeformation
from dnerf.fields import DeformedField
from dnerf.rendering import Renderer
from dnerf.scenes import AnalyticScene
from dnerf.training import runs
from dnerf.training.runs import build, load_config, load_run
from dnerf.training.tensor_files import save_weights

BOX = [[-1.0, -1, -1], [1.0, 1, 1]]
FIELD: dict[str, Any] = {"_target_": "dnerf.fields.GridField", "box": BOX, "resolutions": [2, 4], "num_features": 2}
CONFIG: dict[str, Any] = {
    "seed": 3,
    "data": {
        "_target_": "dnerf.data.SyntheticData", "resolution": 8, "num_train": 2, "box": BOX,
        "scene": {"_target_": "dnerf.scenes.library.static.make_static"},
    },
    "renderer": {
        "_target_": "dnerf.rendering.Renderer",
        "field": {
            "_target_": "dnerf.fields.DeformedField", "canonical": FIELD,
            "deformation": {"_target_": "dnerf.deformations.IdentityDeformation"},
        },
        "sampler": {"_target_": "dnerf.samplers.StratifiedSampler", "num_samples": 4, "box": BOX},
    },
}  # fmt: skip
OUTSIDE = "class Doubled:\n    def __init__(self, value, **others):\n        self.value = 2 * value\n"


@pytest.fixture
def outside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of a package that is not this one."""
    (tmp_path / "outside_of_it").mkdir()
    (tmp_path / "outside_of_it" / "__init__.py").write_text(f"import os\n{OUTSIDE}")
    (tmp_path / "outside_of_it" / "broken.py").write_text("1 / 0\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    return "outside_of_it"


def test_a_config_becomes_objects_and_stays_as_it_is() -> None:
    before = json.dumps(CONFIG)
    renderer = build(CONFIG["renderer"])
    assert isinstance(renderer, Renderer)
    assert isinstance(renderer.field, DeformedField)
    assert isinstance(renderer.field.deformation, IdentityDeformation)
    assert isinstance(build(CONFIG["data"]["scene"]), AnalyticScene)
    assert build({"a": [1, {"b": None}], "c": "x"}) == {"a": [1, {"b": None}], "c": "x"}
    assert json.dumps(CONFIG) == before


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"resolutions": [2, 0]}, "renderer.field.resolutions must be > 0 and finite, got 0"),
        ({"num_features": "many"}, "renderer.field.num_features must be a number, got 'many'"),
        ({"colour": 1}, "renderer.field.colour is none of GridField's arguments: box, resolutions, "),
        ({"_partial_": True}, "renderer.field._partial_ is none of GridField's arguments"),
        ({"_args_": [1]}, "renderer.field._args_ is none of GridField's arguments"),
        ({"box": None}, "renderer.field"),
        ({"resolutions": 3}, "renderer.field: 'int' object is not iterable"),
        ({"space_time": {"_target_": "dnerf.fields.PlaneFeatures"}}, "renderer.field.space_time.box is missing"),
    ],
)
def test_an_error_names_its_place(change: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=r"^renderer\.field") as error:
        build({**FIELD, **change}, "renderer.field")
    assert str(error.value).startswith(said)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("argument", "end"), [("space_time", "; GridField, PlanesField would take it"), ("nosuch", "")]
)
def test_an_argument_of_others_names_who_takes_it(argument: str, end: str) -> None:
    with pytest.raises(ValueError, match=f"^field.{argument} is none of VoxelField's arguments: .*, max_gib{end}$"):
        build({"_target_": "dnerf.fields.VoxelField", "box": BOX, argument: None}, "field")


@pytest.mark.parametrize(
    "target",
    [
        "os.system", "builtins.exec", "", "dnerf", 3, None, "dnerf.core.files.write_text", "dnerf.core.files.os.system",
        "dnerf.training.runs.Path", "dnerf.nothing.Here", "dnerf.fields.Nothing", "dnerfs.Own",
        "dnerf.scenes.make_scene",
    ],
)  # fmt: skip
@pytest.mark.parametrize("deep", [False, True])
def test_a_run_names_classes_of_this_package_and_scenes_only(target: object, deep: bool) -> None:
    node = {"_target_": target}
    with pytest.raises(ValueError, match=r"_target_ (must be|names)"):
        build({"a": [{"b": node}]} if deep else node)


def test_ones_own_command_line_names_any_class_and_nothing_else(outside: str) -> None:
    assert build({"_target_": f"{outside}.Doubled", "value": 2, "any": 3}, trusted=True).value == 4
    assert build({"_target_": "torch.nn.Linear", "in_features": 1, "out_features": 1}, trusted=True).bias is not None
    for target in ("os.system", f"{outside}.os.system", "nowhere.Thing"):
        with pytest.raises(ValueError, match="_target_"):
            build({"_target_": target}, trusted=True)
    with pytest.raises(ValueError, match=r"x\._target_ names nothing .*division by zero"):
        build({"_target_": f"{outside}.broken.Thing"}, "x", trusted=True)


def test_a_run_names_packages_that_the_user_lists(outside: str, monkeypatch: pytest.MonkeyPatch) -> None:
    node = {"_target_": f"{outside}.Doubled", "value": 2}
    with pytest.raises(ValueError, match=rf"x\._target_ .*DNERF_PLUGINS={outside} trusts it"):
        build(node, "x")
    with monkeypatch.context() as patched:
        patched.setenv("DNERF_PLUGINS", f"other, {outside}")
        assert build(node).value == 4
        with pytest.raises(ValueError, match="must be a class"):  # of that package, not what it imports
            build({"_target_": f"{outside}.os"})
    with pytest.raises(ValueError, match="DNERF_PLUGINS"):
        build(node)
    installed = EntryPoints([EntryPoint("mine", outside, "dnerf.plugins")])
    monkeypatch.setattr(runs, "entry_points", lambda group: installed.select(group=group))
    assert build(node).value == 4


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The folder of a run, as training leaves it."""
    save_weights(build(CONFIG["renderer"]), tmp_path / "model.safetensors")
    (tmp_path / "config.yaml").write_text(json.dumps(CONFIG))
    return tmp_path


def test_a_loaded_run_is_the_model_its_config_and_its_data(folder: Path) -> None:
    run = load_run(folder)
    assert run.config == CONFIG
    assert run.folder == folder
    assert not run.renderer.training
    camera = Camera(Intrinsics.from_angle(6, 4, 0.7), look_at((0.0, 4.0, 1.0)))
    image = run.renderer.render_image(camera, 0.5)
    assert image.rgb.shape == (4, 6, 3)
    assert torch.equal(image.rgb, load_run(str(folder)).renderer.render_image(camera, 0.5).rgb)
    with pytest.raises(ValueError, match=r"scene\.json: file does not exist"):
        run.data()
    build(CONFIG["data"]).record().write(folder)
    data = run.data()
    assert isinstance(data, SyntheticData)
    assert data.world() == run.scene().world
    assert len(data.frames("train")) == 2


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"renderer": {"_target_": "os.system"}}, r"config\.yaml: renderer\._target_ must be a class of dnerf"),
        ({"data": {"_target_": "x.Y"}}, r"config\.yaml: data\._target_ must be a class of dnerf"),
        ({"renderer": FIELD}, r"config\.yaml: renderer must be a Renderer, got GridField"),
        ({"renderer": None}, r"config\.yaml: expected a mapping with renderer and data"),
        ({"seed": "${oc.env:HOME}"}, r"config\.yaml: seed must be a resolved value"),
        ({"seed": {"a\nb": 2}}, r"config\.yaml: seed: keys must be short texts, got 'a"),
    ],
)
def test_what_is_no_run_is_refused(folder: Path, change: dict[str, Any], named: str) -> None:
    (folder / "config.yaml").write_text(json.dumps(CONFIG | change))
    with pytest.raises(ValueError, match=named):
        load_run(folder)


def test_a_folder_without_a_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is not the folder of a run"):
        load_config(tmp_path)


def test_what_is_no_data_source_is_refused(folder: Path) -> None:
    (folder / "config.yaml").write_text(json.dumps(CONFIG | {"data": FIELD}))
    with pytest.raises(ValueError, match="data must be a DataSource, got GridField"):
        load_run(folder).data()
