"""The scripts as a user runs them: in processes of their own."""

import json

import imageio.v3 as iio
import pytest
from launcher import run_script

from dnerf.planning.plan import load_plan

TINY = (
    "data.resolution=24", "data.num_train=4", "data.num_val=1", "data.num_test=2", "trainer.num_steps=3",
    "trainer.num_rays=32", "~trainer.callbacks.progress_bar", "sampler.grid.resolution=16",
)  # fmt: skip


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    cwd = tmp_path_factory.mktemp("work")
    previews = ("+trainer/callbacks=previews", "trainer.callbacks.previews.every=2")
    done = run_script("train", "experiment=demo", *TINY, *previews, "out_dir=run", cwd=cwd)
    assert done.returncode == 0, done.stderr
    return cwd


def test_training_leaves_a_complete_run_folder(trained):
    run = trained / "run"
    assert {p.name for p in run.iterdir()} >= {
        "config.yaml", "model.safetensors", "log.jsonl", "training.json", "metrics.json", "previews",
    }  # fmt: skip
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics.keys() >= {
        "split", "psnr", "ssim", "num_frames", "seconds_per_frame", "train_seconds", "num_steps", "num_parameters",
        "frames",
    }  # fmt: skip
    assert metrics["num_steps"] == 3
    assert metrics["weights_bytes"] == (run / "model.safetensors").stat().st_size
    assert [set(f) for f in metrics["frames"]] == [{"index", "time", "psnr", "ssim"}] * 2
    assert iio.imread(run / "contact_sheet_test.png").ndim == 3
    assert len(list((run / "previews").glob("*.png"))) == 1


def test_evaluation_repeats_the_scores_of_training(trained):
    before = json.loads((trained / "run" / "metrics.json").read_text())
    done = run_script("evaluate", "run=run", "split=test", "kinds=true", cwd=trained)
    assert "of the squared error, " in done.stdout
    assert done.returncode == 0, done.stderr
    after = json.loads((trained / "run" / "metrics.json").read_text())
    assert after["frames"] == before["frames"]
    assert f"{after['psnr']:.2f}" in done.stdout
    assert "run/metrics.json" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "count"),
    [
        (("path=orbit", "num_frames=3", "format=png"), 3),
        (("path=spiral", "num_frames=2", "format=png", "time=0.5"), 2),
        (("path=fixed", "num_frames=2", "format=png", "time=pingpong"), 2),
        (("path=fixed", "path.frame=null", "num_frames=1", "format=png", "time=sweep"), 1),
        (("path=test", "format=png"), 2),
    ],
)
def test_render_writes_every_path(trained, arguments, count, tmp_path):
    done = run_script("render", "run=run", *arguments, f"output={tmp_path / 'frames'}", cwd=trained)
    assert done.returncode == 0, done.stderr
    images = sorted((tmp_path / "frames").glob("*.png"))
    assert len(images) == count
    assert iio.imread(images[0]).shape == (24, 24, 3)


def test_render_writes_a_video(trained):
    done = run_script("render", "run=run", "path=orbit", "num_frames=5", "fps=10", "format=mp4", cwd=trained)
    assert done.returncode == 0, done.stderr
    assert iio.imread(trained / "run" / "renders" / "orbit.mp4").shape[0] == 5


def test_exported_scene_trains(tmp_path):
    made = run_script(
        "make_dataset", "scene=static", "num_frames=3", "num_val=1", "num_test=1", "resolution=16", "out=data/static",
        cwd=tmp_path,
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    done = run_script(
        "train", "experiment=fast", "data=blender", "data.root=data/static", "data.resolution=16",
        "trainer.num_steps=2", "~trainer.callbacks.progress_bar", "sampler.grid.resolution=16", "out_dir=run",
        cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_multirun_gives_each_job_its_folder(tmp_path):
    done = run_script("train", "--multirun", "experiment=demo", *TINY, "seed=0,1", "out_dir=sweep", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert len(list((tmp_path / "sweep").glob("*/metrics.json"))) == 2


def test_parts_about_what_a_model_lacks_are_left_as_they_are_and_odd_choices_warned_of(tmp_path):
    lacking = ("field=nerf", "~trainer.losses.appearance_constancy")  # without levels, waves of time or harmonics
    odd = "plan.exposure=drifts"
    done = run_script("train", "experiment=auto", *TINY, *lacking, odd, "out_dir=run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    plan = load_plan(tmp_path / "run" / "plan.yaml").decisions
    given = {name: decision.choice for name, decision in plan.items() if decision.by == "given"}
    assert given.pop("exposure") == "drifts"
    assert given == {"detail": "fine", "colors": "many", "view_dependence": "matte", "appearance": "varying"}
    (warning,) = [line for line in done.stdout.splitlines() if line.startswith("warning: plan.")]
    assert warning.endswith("stands as set, though the question arises with surroundings=surrounded only")


def test_cfg_job_prints_the_config(tmp_path):
    done = run_script("train", "--cfg", "job", "experiment=dnerf", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "dnerf.deformations.DisplacementDeformation" in done.stdout


WRONG = [
    ("train", ("experiment=nosuch",), "experiment/nosuch"),
    ("train", ("scene=nosuch",), "scene/nosuch"),
    ("train", ("trainer.nosuch=1",), "nosuch"),
    ("train", ("experiment=auto", "plan.motion=2", *TINY[:4]), "plan.motion must be one of still, moves"),
    ("train", ("+trainer.nosuch=1", *TINY[:4], "out_dir=fresh"), "trainer.nosuch is none of Trainer's arguments"),
    ("train", ("+trainer.losses.x={_target_: no.such.Loss}", *TINY[:4]), "trainer.losses.x._target_ names nothing"),
    ("train", ("+trainer.losses.x={_target_: os.system}", *TINY[:4]), "trainer.losses.x._target_ must be a class"),
    ("train", ("field=grid", "field.resolutions=[0]", *TINY[:4]), "renderer.field.canonical.resolutions must be > 0"),
    ("train", ("data=blender", "data.root=nowhere", "out_dir=fresh"), "nowhere"),
    ("train", ("data=blender",), "root"),
    ("capture", ("video=nowhere.mp4", "out_dir=fresh"), "nowhere.mp4 does not exist"),
    ("capture", ("video=a.mp4", "out_dir=fresh", "width=0"), "width must be a whole number of at least 1"),
    ("train", ("trainer.num_steps=0", *TINY[:4], "out_dir=fresh"), "num_steps"),
    ("train", ("device=quantum", "out_dir=fresh"), "quantum"),
    ("train", ("out_dir=run", *TINY), "out_dir"),
    ("evaluate", ("run=nowhere",), "nowhere"),
    ("evaluate", ("run=run", "split=nosuch"), "split"),
    ("evaluate", (), "run"),
    ("render", ("run=run", "path=nosuch"), "path/nosuch"),
    ("render", ("run=run", "format=avi"), "format"),
    ("render", ("run=run", "num_frames=0"), "num_frames"),
    ("render", ("run=run", "time=2.0"), "time"),
    ("render", ("run=run", "path=fixed", "path.frame=99"), "path.frame"),
    ("make_dataset", ("scene=walker",), "out"),
    ("make_dataset", ("out=run",), "out"),
    ("make_dataset", ("out=fresh", "resolution=0"), "resolution"),
]


@pytest.mark.parametrize(("script", "arguments", "named"), WRONG)
def test_wrong_input_ends_in_one_line_and_exit_code_2(trained, script, arguments, named):
    before = sorted(trained.rglob("*"))
    done = run_script(script, *arguments, cwd=trained)
    assert done.returncode == 2, (done.returncode, done.stderr)
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("error: ")
    assert named in lines[0]
    assert sorted(trained.rglob("*")) == before


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ("_target_: os.system", "_target_"),
        ("_target_: dnerf.core.files.write_text", "_target_"),
        ("_target_: dnerf.core.files.os.system", "_target_"),
        ("_target_: dnerf.rendering.renderer.Renderer\n  field: ${oc.env:HOME}", "interpolation"),
        ("[unclosed", "config.yaml"),
    ],
)
def test_hostile_run_config_is_refused(tmp_path, change, named):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text(f"data: {{}}\nrenderer:\n  {change}\n")
    done = run_script("evaluate", "run=run", cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert named in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_checkpoint_that_does_not_fit_is_refused(trained, tmp_path):
    import shutil

    shutil.copytree(trained / "run", tmp_path / "run")
    config = tmp_path / "run" / "config.yaml"
    config.write_text(config.read_text().replace("hidden_features: 64", "hidden_features: 32"))
    done = run_script("evaluate", "run=run", cwd=tmp_path)
    assert done.returncode == 2
    assert "model.safetensors" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_tracks_of_a_flow_are_followed_and_drawn(tmp_path):
    done = run_script(
        "train", "experiment=flow", "data=synthetic", "scene=bouncing_balls", "data.train_end=0.5",
        "+field.density_shift=4.0", *TINY, "out_dir=run", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "extrapolation: " in done.stdout
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    counts = [metrics[name]["num_frames"] for name in ("interpolation", "extrapolation")]
    assert metrics["train_end"] == 0.5
    assert counts == [1, 1]
    # So dense from the start an image shows something, untrained.
    done = run_script("tracks", "run=run", "num_frames=2", "spacing=6", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "smallest Jacobian determinant along the tracks: " in done.stdout
    assert (tmp_path / "run" / "renders" / "tracks.npz").exists()
