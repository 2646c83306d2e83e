"""Frames that survive a kill, and films that do not depend on who rendered which frame."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from reference import FormulaField

from dnerf import visualization as films
from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.data.normalization import Clock, Similarity, upright
from dnerf.data.scene_record import World
from dnerf.deformations import DisplacementDeformation, IdentityDeformation
from dnerf.fields import DeformedField, TimeDependence
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.scenes import exact_flow, make_scene

BOX = [[-1.3, -1.3, -1.0], [1.3, 1.3, 1.0]]
INTRINSICS = Intrinsics.from_angle(20, 16, 0.7)


def make_renderer(num_samples: int = 48) -> Renderer:
    """A scene that moves exactly, seen through fixed samples."""
    return Renderer(make_scene("orbiting_balls"), StratifiedSampler(num_samples, BOX))


def some_views(count: int) -> list[films.View]:
    poses = films.spiral_path(count, turns=0.1)
    return films.make_views(poses, films.sweep_times(count, 0.2, 0.4), INTRINSICS, [(2.0, 6.0)] * count)


def truth(view: films.View) -> torch.Tensor:
    return torch.full((16, 20, 3), view.time)


ALL_BUT_DEFORMATION = [output for output in films.OUTPUTS if output != "deformation"]


def test_layers_are_those_of_the_renderer() -> None:
    renderer, views = make_renderer(), some_views(2)
    layers = films.render_layers(renderer, views[0], views[1], ALL_BUT_DEFORMATION, truth=truth)
    image = renderer.render_image(views[0].camera, views[0].time)
    np.testing.assert_array_equal(layers["rgb"], (image.rgb.clamp(0, 1) * 255).round().byte())
    np.testing.assert_array_equal(layers["opacity"], image.opacity)
    np.testing.assert_array_equal(layers["depth"], image.depth)
    assert (layers["truth"] == round(0.2 * 255)).all()


def test_motion_is_the_exact_motion_to_the_next_frame() -> None:
    renderer, views = make_renderer(600), some_views(2)
    motion = torch.from_numpy(films.render_layers(renderer, views[0], views[1], ["motion"])["motion"])
    exact = exact_flow(renderer.field, views[0].camera, views[0].time, views[1].camera, views[1].time)
    both = motion.isfinite().all(-1) & exact.vectors.isfinite().all(-1)
    assert both.sum() > 50
    error = (motion - exact.vectors).norm(dim=-1)[both]
    # A body of density 80 is visible 0.0125 behind its surface; a turn by 72 degrees makes 0.015 of it, 0.1 pixels.
    assert error.median() < 0.1
    assert exact.vectors[both].norm(dim=-1).median() > 1
    last = films.render_layers(renderer, views[0], None, ["motion"])["motion"]
    assert np.isnan(last).all()


def test_deformation_magnitude_is_that_of_a_known_shift() -> None:
    deformation = DisplacementDeformation(1, 8, (), canonical_time=0.0)
    with torch.no_grad():
        deformation.mlp.output.bias.copy_(torch.tensor([0.3, 0.0, 0.4]))
    renderer = Renderer(DeformedField(deformation, make_scene("static")), StratifiedSampler(64, BOX))
    camera = Camera(INTRINSICS, look_at((3.5, 0, 1.5)))
    magnitude = films.deformation_magnitude(renderer, camera, 0.5)
    opaque = renderer.render_image(camera, 0.5).opacity > 0.5
    torch.testing.assert_close(magnitude[opaque], torch.full_like(magnitude[opaque], 0.25), rtol=1e-5, atol=0)
    assert (films.deformation_magnitude(renderer, camera, 0.0) == 0).all()


def test_outputs_that_cannot_be_made_are_named() -> None:
    view = some_views(1)[0]
    with pytest.raises(ValueError, match="compare needs true images"):
        films.render_layers(make_renderer(), view, None, ["compare"])
    with pytest.raises(ValueError, match="deformation needs a model with a deformation"):
        films.render_layers(make_renderer(), view, None, ["deformation"])
    for outputs in ([], ["rgb", "rgb"], ["sound"]):
        with pytest.raises(ValueError, match="outputs must"):
            films.render_layers(make_renderer(), view, None, outputs)


class Opaque(FormulaField, TimeDependence):
    """A ball that is the same at all times, whether it says so or not."""

    is_static = True

    def __init__(self, says: bool) -> None:
        super().__init__(
            lambda positions: 50.0 * (positions.norm(dim=-1) < 0.8),
            lambda positions, *_: torch.full_like(positions, 0.5),
        )
        self.is_static = says


def test_what_is_static_does_not_move_and_what_is_unknown_is_no_number() -> None:
    camera = Camera(INTRINSICS, look_at((3.5, 0, 1.5)))
    for says in (True, False):
        renderer = Renderer(DeformedField(IdentityDeformation(), Opaque(says)), StratifiedSampler(48, BOX))
        motion = films.render_layers(renderer, films.View(camera, 0.1), films.View(camera, 0.9), ["motion"])["motion"]
        assert np.isfinite(motion).any() == says
        assert not np.nan_to_num(motion).any()


@pytest.mark.parametrize("radius", [8.0, 4.0, 1.6, 1.0, 0.3])
def test_planes_hold_the_whole_box_wherever_the_camera_is(tmp_path: Path, radius: float) -> None:
    poses = films.spiral_path(3, radius=radius)
    planes = films.box_planes(poses, BOX)
    for pose, (near, far) in zip(poses, planes):
        camera = Camera(INTRINSICS, pose, near, far)
        corners = torch.cartesian_prod(*torch.tensor(BOX).T)
        depth = camera.project(corners)[1]
        assert near == pytest.approx(max(float(depth.min()), 0.0), abs=1e-6)
        assert far == pytest.approx(float(depth.max()), abs=1e-6)
    store = films.FrameStore(tmp_path, 3)
    views = films.make_views(poses, films.sweep_times(3), INTRINSICS, planes)
    films.render_frames_to(store, make_renderer(256), views, ["opacity"])
    assert films.empty_frames(store) == []


def test_an_empty_film_is_noticed(tmp_path: Path) -> None:
    away = films.spiral_path(2, target=(0.0, 0.0, 50.0), radius=1.0)
    store = films.FrameStore(tmp_path, 2)
    views = films.make_views(away, [0.0, 1.0], INTRINSICS, films.box_planes(away, BOX))
    films.render_frames_to(store, make_renderer(), views, ["rgb"])
    assert films.empty_frames(store) == [0, 1]


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def film(folder: Path, stop_after: int | None = None) -> dict[str, bytes]:
    """Render, broken off after some frames and begun again if told so."""
    renderer, views = make_renderer(), some_views(5)
    store = films.FrameStore(folder / "frames", len(views))

    class Killed(Exception):
        pass

    def stop(index: int) -> None:
        if stop_after is not None and len(list(store.folder.iterdir())) >= stop_after:
            raise Killed

    try:
        films.render_frames_to(store, renderer, views, ALL_BUT_DEFORMATION, truth=truth, on_frame=stop)
    except Killed:
        films.render_frames_to(store, renderer, views, ALL_BUT_DEFORMATION, truth=truth)
    assert store.missing() == []
    films.write_films(store, folder / "film", ALL_BUT_DEFORMATION, ["mp4", "gif", "png", "npz"], fps=10, views=views)
    store.remove()
    assert not store.folder.exists()
    return files(folder)


def test_broken_off_renderings_give_the_same_bytes(tmp_path: Path) -> None:
    whole = film(tmp_path / "whole")
    assert {name for name in whole if "/" not in name} == {
        "film.npz",
        *(
            f"film{suffix}.{f}"
            for suffix in ("", "_depth", "_opacity", "_motion", "_normals", "_compare")
            for f in ("mp4", "gif")
        ),
    }
    assert film(tmp_path / "resumed", stop_after=2) == whole


KILLED = """
import os, signal, sys
from pathlib import Path
sys.path[:0] = sys.argv[2:]
from test_films import films, make_renderer, some_views
def kill(index):
    if index == 2:
        os.kill(os.getpid(), signal.SIGKILL)
films.render_frames_to(films.FrameStore(Path(sys.argv[1]), 5), make_renderer(), some_views(5), ["rgb"], on_frame=kill)
"""


def test_a_killed_process_loses_no_finished_frame(tmp_path: Path) -> None:
    command = [sys.executable, "-c", KILLED, tmp_path / "frames", *Path(__file__).parents[:2]]
    done = subprocess.run(command, check=False, env=os.environ)
    assert done.returncode == -signal.SIGKILL
    store, views = films.FrameStore(tmp_path / "frames", 5), some_views(5)
    assert store.missing() == [3, 4]
    before = {i: store.path(i).stat().st_mtime_ns for i in range(3)}
    assert films.render_frames_to(store, make_renderer(), views, ["rgb"]) == 2
    assert {i: store.path(i).stat().st_mtime_ns for i in range(3)} == before
    fresh = films.FrameStore(tmp_path / "fresh", 5)
    films.render_frames_to(fresh, make_renderer(), views, ["rgb"])
    assert files(store.folder) == files(fresh.folder)


def test_raw_arrays_and_films_hold_every_frame(tmp_path: Path) -> None:
    renderer, views = make_renderer(), some_views(3)
    store = films.FrameStore(tmp_path / "frames", 3)
    films.render_frames_to(store, renderer, views, ["rgb", "depth"])
    (path,) = films.write_films(store, tmp_path / "film", ["rgb", "depth"], ["npz"], fps=12, views=views)
    with np.load(path) as arrays:
        facts = {"fps", "times", "data_times", "poses", "intrinsics", "pixel_origin"}
        assert set(arrays.files) == {"rgb", "depth", "opacity", "max_opacity"} | facts
        assert arrays["pixel_origin"].tolist() == ["center"] * 3
        assert arrays["rgb"].shape == (3, 16, 20, 3)
        assert arrays["fps"] == 12
        for i, view in enumerate(views):
            np.testing.assert_array_equal(arrays["depth"][i], renderer.render_image(view.camera, view.time).depth)
            np.testing.assert_array_equal(arrays["poses"][i], view.camera.pose)
            assert arrays["times"][i] == view.time
        focal = INTRINSICS.focal_x
        np.testing.assert_allclose(arrays["intrinsics"], [[20, 16, focal, focal, 10, 8]] * 3)
    # In the data set's own units and clock, where there are such.
    world = World(((-1.0,) * 3, (1.0,) * 3), Similarity(0.5, upright((0, 1, 0)), (1.0, 2.0, 3.0)), Clock(10.0, 4.0))
    own = films.FrameStore(tmp_path / "own", 3)
    films.render_frames_to(own, renderer, views, ["depth"], unit=0.5)
    (path,) = films.write_films(own, tmp_path / "own", ["depth"], ["npz"], views=views, world=world)
    with np.load(path) as arrays:
        image = renderer.render_image(views[1].camera, views[1].time)
        np.testing.assert_array_equal(arrays["depth"][1], image.depth / 0.5)
        back = world.similarity.poses_to_world(torch.from_numpy(arrays["poses"][1]))
        torch.testing.assert_close(back.float(), views[1].camera.pose)
        assert arrays["data_times"][1] == pytest.approx(10 + 4 * views[1].time)
    (path,) = films.write_films(store, tmp_path / "film", ["depth"], ["mp4"], fps=10)
    assert path.name == "film.mp4"
    shape = iio.imread(path).shape
    assert shape[:2] == (3, 16)
    assert shape[2] > 20  # the scale stands beside the image


def test_damaged_and_missing_frames_are_named(tmp_path: Path) -> None:
    store = films.FrameStore(tmp_path, 2)
    store.write(0, {"rgb": np.zeros((2, 2, 3), np.uint8)})
    with pytest.raises(ValueError, match=r"frame_00001\.npz: not a readable frame"):
        list(store)
    store.write(1, {"rgb": np.zeros((2, 3, 3), np.uint8)})
    with pytest.raises(ValueError, match=r"frame_00001\.npz: rgb must be uint8"):
        films.write_npz(store, tmp_path / "a.npz", {})
    assert not (tmp_path / "a.npz").exists()
    store.path(1).write_bytes(store.path(1).read_bytes()[:100])
    with pytest.raises(ValueError, match=r"frame_00001\.npz: not a readable frame"):
        store.read(1)


def test_digest_tells_sequences_apart_and_views_outside_of_time_are_refused() -> None:
    views, facts = some_views(3), {"model": "abc"}
    names = [
        films.sequence_digest(views, facts),
        films.sequence_digest(views[:2], facts),
        films.sequence_digest(views, {"model": "abd"}),
        films.sequence_digest([*views[:2], films.View(views[2].camera, 0.9)], facts),
        films.sequence_digest([*views[:2], films.View(views[1].camera, views[2].time)], facts),
    ]
    assert len(set(names)) == 5
    assert films.sequence_digest(some_views(3), facts) == names[0]
    with pytest.raises(ValueError, match=r"time must be in \[0, 1\], got 1.5"):
        films.View(some_views(1)[0].camera, 1.5)


def test_a_frame_that_cannot_be_written_ends_the_rendering(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write, told = films.FrameStore.write, []

    def failing(self: films.FrameStore, index: int, layers: dict) -> None:
        if index == 1:
            raise OSError("no space left")
        write(self, index, layers)

    monkeypatch.setattr(films.FrameStore, "write", failing)
    store = films.FrameStore(tmp_path, 4)
    with pytest.raises(OSError, match="no space left"):
        films.render_frames_to(store, make_renderer(), some_views(4), ["rgb"], on_frame=told.append)
    assert told == [0]
    assert store.missing() == [1, 2, 3]


def test_a_rendering_that_fails_keeps_the_frame_before_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    render, told = Renderer.render_image, []
    views = some_views(4)

    def failing(self: Renderer, camera: Camera, time: float, **options: int) -> object:
        if time == views[2].time:
            raise FloatingPointError("NaN")
        return render(self, camera, time, **options)

    monkeypatch.setattr(Renderer, "render_image", failing)
    store = films.FrameStore(tmp_path, 4)
    with pytest.raises(FloatingPointError, match="NaN"):
        films.render_frames_to(store, make_renderer(), views, ["rgb"], on_frame=told.append)
    assert told == [0, 1]
    assert store.missing() == [2, 3]
