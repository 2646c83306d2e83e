"""render.py, evaluate.py and report.py as a user runs them: killed and begun again, by protocol, as a page."""

import importlib
import json
import os
import re
import shutil
import signal
import time
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
import yaml
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from launcher import ROOT, Run, run_script
from omegaconf.errors import OmegaConfBaseException
from test_scripts import TINY

from dnerf.data import FolderData, SceneRecord
from dnerf.evaluation import psnr
from dnerf.evaluation.protocols import PROTOCOLS, Protocol

KEYS = {"keyframes": [{"seconds": 0, "time": 0.1, "azimuth": 0}, {"seconds": 0.5, "time": 0.6, "azimuth": 40}]}


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """A folder with a run of a blender scene called lego, 24 x 24 images with alpha."""
    cwd = tmp_path_factory.mktemp("sequences")
    made = run_script(
        "make_dataset", "scene=walker", "num_frames=3", "num_val=1", "num_test=2", "resolution=24", "out=data/lego",
        cwd=cwd,
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    done = run_script(
        "train", "experiment=fast", "data=blender", "data.root=data/lego", "data.resolution=24", *TINY[4:],
        "++field.density_shift=2.0", "out_dir=run", "seed=3", cwd=cwd,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return cwd


@pytest.fixture(autouse=True)
def in_the_work_folder(work, monkeypatch):
    monkeypatch.chdir(work)
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))


def call(script: str, *overrides: str) -> None:
    """A script's own work on a composed config, without the seconds that a process of its own takes to start."""
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        config = compose(script, list(overrides))
    importlib.import_module("settings").check_settings(config, script)
    importlib.import_module(script).main(config)


def films(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}


def test_a_killed_rendering_goes_on_and_gives_the_same_bytes(work, capsys):
    arguments = ("run=run", "path=orbit", "num_frames=16", "fps=10", "format=[mp4,npz]", "outputs=[rgb,depth]")
    call("render", *arguments, "output=whole/film")
    rendering = Run("render", *arguments, "output=killed/film", cwd=work)
    deadline = time.monotonic() + 120
    while len(list((work / "killed").glob(".film.*/frame_*.npz"))) < 4:
        assert time.monotonic() < deadline
        time.sleep(0.005)
    os.kill(rendering.pid, signal.SIGKILL)
    assert rendering.wait().returncode == -signal.SIGKILL, "it was over before it could be killed"
    finished = list((work / "killed").glob(".film.*/frame_*.npz"))
    assert 4 <= len(finished) < 16
    assert not (work / "killed" / "film.mp4").exists()
    before = {path: path.stat().st_mtime_ns for path in finished}
    call("render", *arguments, "output=killed/film", "keep_frames=true")
    assert f"{len(finished)} of 16 frames are there already" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in finished} == before
    assert films(work / "killed") == films(work / "whole")
    assert not list((work / "whole").glob(".film.*")), "finished frames are removed"


def test_key_frames_make_a_film_at_their_own_pace(work):
    (work / "keys.json").write_text(json.dumps(KEYS))
    call(
        "render", "run=run", "path=keyframes", "path.file=keys.json", "fps=10", "resolution=[32,20]",
        "format=[mp4,npz]", "output=keys/film",
    )  # fmt: skip
    assert iio.imread(work / "keys" / "film.mp4").shape == (6, 20, 32, 3)
    with np.load(work / "keys" / "film.npz") as arrays:
        assert arrays["times"][[0, -1]] == pytest.approx([0.1, 0.6])
        assert arrays["intrinsics"][0, 2] == pytest.approx(arrays["intrinsics"][0, 3]), "pixels stay square"


def test_a_camera_that_key_frames_misplace_is_named_with_its_file(work):
    (work / "inside.json").write_text(
        json.dumps({"keyframes": [{"seconds": 0, "eye": [0, 0, 0], "target": [0, 0, 0]}]})
    )
    with pytest.raises(ValueError, match=r"inside.json: keyframes at 0 seconds: eye must differ from target"):
        call("render", "run=run", "path=keyframes", "path.file=inside.json")


def test_outputs_of_a_film_within_a_range_of_times(work):
    call(
        "render", "run=run", "path=fixed", "time=sweep", "time_range=[0.2,0.8]", "num_frames=5", "format=npz",
        "outputs=[deformation,motion]", "output=part/film.npz",
    )  # fmt: skip
    with np.load(work / "part" / "film.npz") as arrays:
        assert arrays["times"] == pytest.approx([0.2, 0.35, 0.5, 0.65, 0.8])
        assert arrays["motion"].shape == (5, 24, 24, 2)
        assert np.isnan(arrays["motion"][-1]).all()
        assert arrays["deformation"].shape == (5, 24, 24)


@pytest.mark.parametrize("path", ["orbit", "spiral", "fixed", "keyframes", "test"])
def test_every_path_is_filmed_from_the_run_s_own_record(work, path, monkeypatch):
    """The data set is gone: cameras, times and box are in the run."""
    (work / "keys.json").write_text(json.dumps(KEYS))
    (work / "data").rename(work / "away")
    file = ("path.file=keys.json",) if path == "keyframes" else ()
    arguments = ("run=run", f"path={path}", "num_frames=2", "fps=2", "format=npz", *file)
    try:
        for split in ("train", "val"):
            call("render", *arguments, f"path.split={split}", f"output=gone/{split}")
            with np.load(work / "gone" / f"{split}.npz") as arrays:
                assert np.isfinite(arrays["poses"]).all()
        with pytest.raises(ValueError, match="data/lego"):
            call("render", "run=run", "path=test", "outputs=[compare]", "output=gone/none")
        with pytest.raises(ValueError, match="data/lego"):
            call("evaluate", "run=run")
    finally:
        (work / "away").rename(work / "data")
        shutil.rmtree(work / "gone")


def test_a_film_s_lengths_and_times_are_those_of_the_data_set(work):
    placed = ("path=orbit", "path.radius=5", "path.target=[0.5,0,0]", "path.elevation=0", "path.turns=1")
    call("render", "run=run", *placed, "num_frames=3", "format=npz", "outputs=[depth]", "output=own/film")
    with np.load(work / "own" / "film.npz") as arrays:
        eyes = arrays["poses"][:, :3, 3]
        np.testing.assert_allclose(np.linalg.norm(eyes - [0.5, 0, 0], axis=-1), 5, rtol=1e-5)
        np.testing.assert_allclose(eyes[:, 2], 0, atol=1e-5)
        np.testing.assert_array_equal(arrays["data_times"], arrays["times"])
        shown = arrays["depth"][arrays["opacity"] > 0.5]
        assert ((shown > 2) & (shown < 8)).all()


def test_times_beyond_training_are_shown_when_told_with_a_warning(work, capsys):
    config = yaml.safe_load((work / "run" / "config.yaml").read_text())
    shutil.copytree(work / "run", work / "short")
    scene = json.loads((work / "short" / "scene.json").read_text())
    scene["cameras"]["train"]["times"] = [0.25, 0.5, 0.75]
    scene["world"]["clock"] = {"start": 100.0, "length": 8.0}
    (work / "short" / "scene.json").write_text(json.dumps(scene))
    common = ("run=short", "path=fixed", "num_frames=3", "format=npz", "output=short/film")
    call("render", *common)
    with np.load(work / "short" / "film.npz") as arrays:
        assert arrays["times"].tolist() == [0.25, 0.5, 0.75]
        assert arrays["data_times"].tolist() == [102.0, 104.0, 106.0]
    assert "warning" not in capsys.readouterr().err
    call("render", *common, "time_range=[100,108]", "clock=data")
    with np.load(work / "short" / "film.npz") as arrays:
        assert arrays["times"].tolist() == [0.0, 0.5, 1.0]
    assert "beyond them nothing was learnt" in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"time must be .* in \[100, 108\] by clock=data, got 99"):
        call("render", *common, "time=99", "clock=data")
    assert config["data"]["box"] == "auto"


def test_an_empty_film_and_empty_frames_are_noticed(work, capsys):
    call("render", "run=run", "path.radius=8", "num_frames=1", "format=png", "output=far/film")
    assert "warning" not in capsys.readouterr().err
    call("render", "run=run", "path.target=[0,0,99]", "num_frames=1", "format=png", "output=far/empty")
    assert "warning: the film is empty" in (said := capsys.readouterr().err)
    assert "path.target=[0, 0, 99]" in said
    keys = [
        {"seconds": 0, "eye": [4, 0, 1], "target": [0, 0, 0]},
        {"seconds": 0.5, "eye": [4, 0, 1], "target": [9, 0, 1]},
    ]
    (work / "away.json").write_text(json.dumps({"interpolation": "linear", "keyframes": keys}))
    call("render", "run=run", "path=keyframes", "path.file=away.json", "fps=4", "format=png", "output=far/some")
    assert "frames show nothing" in capsys.readouterr().err


def test_consistency_is_checked_and_written(work, capsys, monkeypatch):
    monkeypatch.setattr(importlib.import_module("evaluate"), "CONSISTENCY_PIXELS", 8)
    call("evaluate", "run=run", "worst=0", "plots=false", "consistency=true")
    checks = json.loads((work / "run" / "consistency.json").read_text())["checks"]
    assert [check["check"] for check in checks] == ["time continuity", "no popping", "colour along tracks"]
    assert all(check["check"] in capsys.readouterr().out for check in checks[:1])


def test_truth_stands_beside_the_prediction(work):
    call("render", "run=run", "path=test", "format=png", "outputs=[compare]", "output=compare/film")
    assert len(list((work / "compare" / "film").glob("*.png"))) == 2


def test_evaluation_by_protocol_says_everything_and_makes_tables(work):
    call(
        "evaluate", "runs=[run,run]", "lego_split=val", "table=tables/t", "worst=1", "label=tiny",
        "temporal.enabled=true", "temporal.num_frames=3", "temporal.resolution=16",
    )  # fmt: skip
    metrics = json.loads((work / "run" / "metrics.json").read_text())
    assert metrics.keys() >= {
        "protocol", "seed", "train_seconds", "hardware", "commit", "train_hardware", "train_commit", "resolution",
        "background", "scene", "split", "method",
    }  # fmt: skip
    assert (metrics["scene"], metrics["split"], metrics["seed"], metrics["background"]) == ("lego", "val", 3, "white")
    temporal = json.loads((work / "run" / "temporal.json").read_text())
    assert temporal["motion"] == "model"
    assert "track_error" not in temporal
    rows = json.loads((work / "tables" / "t.json").read_text())["rows"]
    assert [row["method"] for row in rows] == ["tiny", "tiny"]
    table = (work / "tables" / "t.md").read_text()
    assert f"| tiny | lego | val | {metrics['psnr']:.2f} |" in table
    assert (work / "tables" / "t.csv").read_text().count("\n") == 3
    assert (work / "tables" / "t.svg").read_text().startswith("<svg")
    assert (work / "run" / "worst_frames_val.png").exists()


def test_a_film_can_be_rendered_in_longer_steps(work):
    films = []
    for parts in (1, 4):
        output = f"films/parts{parts}"
        call(
            "render", "run=run", "path=fixed", "num_frames=2", "format=npz", f"subdivision={parts}", f"output={output}"
        )
        films.append(np.load(work / f"{output}.npz")["rgb"].astype(float))
    difference = np.abs(films[0] - films[1])
    assert difference.max() > 0
    assert difference.mean() < 10


def test_a_protocol_sets_resolution_background_and_split(work, monkeypatch):
    monkeypatch.setitem(PROTOCOLS, "tiny", Protocol("tiny", 16, "black"))
    call("evaluate", "run=run", "protocol=tiny", "worst=0", "plots=false")
    path = work / "run" / "metrics_tiny_test.json"
    metrics = json.loads(path.read_text())
    path.unlink()  # a report would put it first
    assert (metrics["protocol"], metrics["resolution"], metrics["background"]) == ("tiny", 16, "black")
    hydra_app = importlib.import_module("hydra_app")
    renderer = hydra_app.load_renderer("run", hydra_app.load_config("run"), torch.device("cpu"))
    data = FolderData("data/lego", 16)
    data.settle(SceneRecord.read("run").world)
    frames = data.frames("test")
    for index, scored in enumerate(metrics["frames"]):
        image = renderer.render_image(frames.camera(index), float(frames.times[index]))
        # The model's own background is white: black is what opacity leaves of it.
        on_black = image.rgb - (1 - image.opacity[..., None])
        assert scored["psnr"] == pytest.approx(psnr(on_black, frames.image(index, (0.0, 0.0, 0.0))), abs=1e-3)


def test_images_are_never_enlarged_to_fit_a_protocol(work):
    with pytest.raises(ValueError, match="800"):
        call("evaluate", "run=run", "protocol=gs")


def test_report_is_made_from_what_lies_in_the_run(work):
    call("evaluate", "run=run")
    call("render", "run=run", "num_frames=4", "fps=10")
    done = run_script("report", "run=run", cwd=work)
    assert done.returncode == 0, done.stderr
    text = (work / "run" / "report.html").read_text()
    metrics = json.loads((work / "run" / "metrics.json").read_text())
    for value in (f"{metrics['psnr']:.2f} dB", metrics["commit"], "data:video/mp4", "Worst frames", "num_slabs: 16"):
        assert value in text


WRONG = [
    ("render", ("run=run", "keep_frames=maybe"), "keep_frames must be true or false, got 'maybe'"),
    ("render", ("run=run", "surface=true"), "sphere tracing needs a field with a signed distance"),
    ("render", ("run=run", "subdivision=0"), "subdivision must be a whole number of at least 1 or null, got 0"),
    ("render", ("run=run", "subdivision=1.5"), "subdivision must be a whole number of at least 1 or null, got 1.5"),
    ("render", ("run=run", "path.split=all"), "path.split must be one of train, val, test or null, got 'all'"),
    ("render", ("run=run", "chunk=0"), "chunk must be a whole number of at least 1 or null, got 0"),
    ("render", ("run=run", "num_frames=true"), "num_frames must be a whole number of at least 1, got True"),
    ("render", ("run=run", "format=[]"), "format must be a text or a list of them"),
    ("render", ("run=run", "format=gif", "fps=1000"), "fps must be at most 50 for gif"),
    ("render", ("run=run", "data_root=[a]"), "data_root must be a text or null"),
    ("render", ("run=run", "path=spiral", "path.elevations=[1]"), "path.elevations must be two angles"),
    ("render", ("run=run", "outputs=[sound]"), "outputs"),
    ("render", ("run=run", "outputs=[]"), "outputs"),
    ("render", ("run=run", "outputs=[compare]"), "compare"),
    ("render", ("run=run", "format=[mp4,avi]"), "format"),
    ("render", ("run=run", "time=backwards"), "time"),
    ("render", ("run=run", "time_range=[0.5,2]"), "time_range must be a number in"),
    ("render", ("run=run", "clock=wall"), "clock must be one of run, data, got 'wall'"),
    ("render", ("run=run", "resolution=[20]"), "resolution"),
    ("render", ("run=run", "path=keyframes"), "file"),
    ("render", ("run=run", "path=keyframes", "path.file=nowhere.json"), "nowhere.json"),
    ("evaluate", ("run=run", "protocol=nerf"), "protocol"),
    ("evaluate", ("run=run", "lego_split=other"), "lego_split"),
    ("evaluate", ("run=run", "runs=[run]"), "run"),
    ("evaluate", ("runs=run",), "runs must be a list of texts, got 'run'"),
    ("evaluate", ("run=run", "temporal.num_frames=2"), "temporal.num_frames must be a whole number of at least 3"),
    ("evaluate", ("run=run", "consistency=1"), "consistency must be true or false, got 1"),
    ("tracks", ("run=run", "every=1.5"), "every must be a whole number of at least 1, got 1.5"),
    ("tracks", ("run=run", "output=x.gif"), "must be a file that ends in .mp4, got x.gif"),
    ("tracks", ("run=run", "format=gif", "fps=1000"), "fps must be at most 50 for gif"),
    ("mesh", ("run=run",), "the mesh is empty: no density of"),
    ("mesh", ("run=run", "format=[glb,stl]"), "format must be one of glb, ply, obj; got 'stl'"),
    ("mesh", ("run=run", "time=2"), r"time must be in \[0, 1\], got 2"),
    ("mesh", ("run=run", "resolution=100000"), "fits into memory"),
    ("evaluate", ("runs=[run,nowhere]",), "nowhere"),
    ("evaluate", ("run=run", "lpips.enabled=true"), "lpips"),
    ("report", ("run=nowhere",), "nowhere"),
    ("report", ("run=run", "films=[nowhere.mp4]"), "nowhere.mp4"),
]


@pytest.mark.parametrize(("script", "arguments", "named"), WRONG)
def test_wrong_input_is_named(work, script, arguments, named):
    with pytest.raises((ValueError, OSError, HydraException, OmegaConfBaseException), match=named):
        call(script, *arguments)


def test_the_surface_of_a_run_is_written(work, capsys):
    call("mesh", "run=run", "format=[glb,ply,obj]", "num_frames=3", "resolution=12", "level=5", "lit=true")
    names = sorted(path.name for path in (work / "run" / "meshes").rglob("*.*"))
    frames = [f"mesh_{i:05d}" for i in range(3)]
    assert names == sorted(["mesh.glb", *(f"{frame}.{format}" for frame in frames for format in ("ply", "obj"))])
    said, warned = capsys.readouterr()
    assert "3 frames; 0 vertices left out" in said
    assert "the canonical field changes with time: shape and colours are those of time 0.5" in said
    assert re.match(r"warning: \d+\.\d% of the surface lies on the sides of the run's box, which cuts it", warned)
    assert warned.count("\n") == 1


def test_what_is_refused_leaves_nothing(work):
    """Neither hidden folders of frames nor films."""
    before = sorted(path.name for path in (work / "run").rglob("*"))
    for arguments in (["outputs=[compare]"], ["chunk=-1"], ["fps=-1"], ["path=fixed", "path.frame=99"]):
        with pytest.raises(ValueError, match=r"compare|chunk|fps|frame"):
            call("render", "run=run", *arguments)
    assert sorted(path.name for path in (work / "run").rglob("*")) == before


def test_a_damaged_run_among_several_is_found_before_any_is_scored(work, capsys):
    shutil.copytree(work / "run", work / "broken")
    weights = work / "broken" / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(ValueError, match="broken"):
        call("evaluate", "runs=[run,broken]")
    assert "dB" not in capsys.readouterr().out
    shutil.rmtree(work / "broken")


def test_a_scene_that_has_moved_is_found_where_it_is_now(work):
    shutil.copytree(work / "run", work / "elder")
    config = (work / "elder" / "config.yaml").read_text()
    (work / "elder" / "config.yaml").write_text(config.replace("data/lego", "data/gone"))
    for script, arguments in (("evaluate", ("run=elder", "plots=false")), ("train", ("out_dir=elder", "resume=true"))):
        refused = run_script(script, *arguments, cwd=work)
        assert refused.returncode == 2
        assert "data/gone" in refused.stderr
        done = run_script(script, *arguments, "data_root=data/lego", cwd=work)
        assert done.returncode == 0, done.stderr
    assert "root: data/lego" in (work / "elder" / "config.yaml").read_text()
    shutil.rmtree(work / "elder")


def test_a_split_without_images_is_said_and_not_scored(work, capsys):
    shutil.copytree(work / "data" / "lego", work / "data" / "half")
    for name in ("transforms_test.json", "transforms_val.json"):
        (work / "data" / "half" / name).unlink()
    done = run_script(
        "train", "experiment=fast", "data=auto", "data.root=data/half", "data.hold_out=null", "out_dir=half",
        *TINY[4:], cwd=work,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "nothing will be scored" in done.stdout
    assert not (work / "half" / "metrics.json").exists()
    shutil.rmtree(work / "half")


def test_an_image_that_no_memory_holds_is_an_error_in_one_line(work):
    done = run_script("render", "run=run", "path=fixed", "num_frames=1", "resolution=3000000", cwd=work)
    assert done.returncode == 2
    assert "can't allocate memory" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("script", "name", "content", "named"),
    [
        ("evaluate", "training.json", "{}", "training.json: train_seconds must be a number, got None"),
        ("evaluate", "training.json", "[1]", "training.json: must hold an object, got \\[1\\]"),
        ("report", "temporal.json", '{"motion": 1}', "temporal.json: expected the scores of evaluate.py"),
    ],
)
def test_facts_that_are_missing_are_named_before_anything_is_written(work, script, name, content, named):
    shutil.copytree(work / "run", work / "odd")
    (work / "odd" / name).write_text(content)
    before = (work / "odd" / "metrics.json").read_bytes()
    try:
        with pytest.raises(ValueError, match=named):
            call(script, "run=odd")
        assert (work / "odd" / "metrics.json").read_bytes() == before
    finally:
        shutil.rmtree(work / "odd")
