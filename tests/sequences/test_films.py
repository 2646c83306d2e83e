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

from dnerf.cameras import Camera, Intrinsics, look_at, orbit_path
from dnerf.deformations import DisplacementDeformation, IdentityDeformation
from dnerf.fields import DeformedField
from dnerf.renderer import Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.scenes import exact_flow, make_scene
from dnerf.sequences import (
    OUTPUTS,
    FrameStore,
    Share,
    View,
    deformation_magnitude,
    make_views,
    render_frames_to,
    render_layers,
    sequence_digest,
    sweep_times,
    write_films,
    write_npz,
)

BOX = [[-1.3, -1.3, -1.0], [1.3, 1.3, 1.0]]
INTRINSICS = Intrinsics.from_angle(20, 16, 0.7)


def make_renderer(num_samples: int = 48) -> Renderer:
    """A scene that moves exactly, seen through fixed samples."""
    return Renderer(make_scene("orbiting_balls"), StratifiedSampler(num_samples, BOX))


def some_views(count: int) -> list[View]:
    return make_views(orbit_path(count, turns=0.1), sweep_times(count, 0.2, 0.4), INTRINSICS, 2.0, 6.0)


def truth(view: View) -> torch.Tensor:
    return torch.full((16, 20, 3), view.time)


ALL_BUT_DEFORMATION = [output for output in OUTPUTS if output != "deformation"]


def test_layers_are_those_of_the_renderer() -> None:
    renderer, views = make_renderer(), some_views(2)
    layers = render_layers(renderer, views[0], views[1], ALL_BUT_DEFORMATION, truth=truth)
    image = renderer.render_image(views[0].camera, views[0].time)
    np.testing.assert_array_equal(layers["rgb"], (image.rgb.clamp(0, 1) * 255).round().byte())
    np.testing.assert_array_equal(layers["opacity"], image.opacity)
    np.testing.assert_array_equal(layers["depth"], image.depth)
    assert (layers["truth"] == round(0.2 * 255)).all()


def test_motion_is_the_exact_motion_to_the_next_frame() -> None:
    renderer, views = make_renderer(600), some_views(2)
    motion = torch.from_numpy(render_layers(renderer, views[0], views[1], ["motion"])["motion"])
    exact = exact_flow(renderer.field, views[0].camera, views[0].time, views[1].camera, views[1].time)
    both = motion.isfinite().all(-1) & exact.vectors.isfinite().all(-1)
    assert both.sum() > 50
    error = (motion - exact.vectors).norm(dim=-1)[both]
    # Matter of density 80 is seen 0.0125 behind its surface; a turn by 72 degrees makes 0.015 of it, 0.1 pixels.
    assert error.median() < 0.1
    assert exact.vectors[both].norm(dim=-1).median() > 1
    last = render_layers(renderer, views[0], None, ["motion"])["motion"]
    assert np.isnan(last).all()


def test_deformation_magnitude_is_that_of_a_known_shift() -> None:
    deformation = DisplacementDeformation(1, 8, (), canonical_time=0.0)
    with torch.no_grad():
        deformation.mlp.output.bias.copy_(torch.tensor([0.3, 0.0, 0.4]))
    renderer = Renderer(DeformedField(deformation, make_scene("static")), StratifiedSampler(64, BOX))
    camera = Camera(INTRINSICS, look_at((3.5, 0, 1.5)))
    magnitude = deformation_magnitude(renderer, camera, 0.5)
    opaque = renderer.render_image(camera, 0.5).opacity > 0.5
    torch.testing.assert_close(magnitude[opaque], torch.full_like(magnitude[opaque], 0.25), rtol=1e-5, atol=0)
    assert (deformation_magnitude(renderer, camera, 0.0) == 0).all()


def test_outputs_that_cannot_be_made_are_named() -> None:
    view = some_views(1)[0]
    with pytest.raises(ValueError, match="compare needs true pictures"):
        render_layers(make_renderer(), view, None, ["compare"])
    with pytest.raises(ValueError, match="deformation needs a model with a deformation"):
        render_layers(make_renderer(), view, None, ["deformation"])
    for outputs in ([], ["rgb", "rgb"], ["sound"]):
        with pytest.raises(ValueError, match="outputs must"):
            render_layers(make_renderer(), view, None, outputs)


def test_identity_moves_nothing() -> None:
    field = DeformedField(IdentityDeformation(), make_scene("static"))
    renderer = Renderer(field, StratifiedSampler(48, BOX))
    camera = Camera(INTRINSICS, look_at((3.5, 0, 1.5)))
    motion = render_layers(renderer, View(camera, 0.1), View(camera, 0.9), ["motion"])["motion"]
    assert np.nanmax(np.abs(motion)) == 0


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def film(folder: Path, shares: list[Share], stop_after: int | None = None) -> dict[str, bytes]:
    """Render by shares, the first of them broken off after some frames and begun again."""
    renderer, views = make_renderer(), some_views(5)
    store = FrameStore(folder / "frames", len(views))

    class Killed(Exception):
        pass

    def stop(index: int) -> None:
        if stop_after is not None and len(list(store.folder.iterdir())) >= stop_after:
            raise Killed

    for share in shares:
        try:
            render_frames_to(store, renderer, views, ALL_BUT_DEFORMATION, truth=truth, share=share, on_frame=stop)
        except Killed:
            stop_after = None
            render_frames_to(store, renderer, views, ALL_BUT_DEFORMATION, truth=truth, share=share)
    assert store.missing() == []
    write_films(store, folder / "film", ALL_BUT_DEFORMATION, ["mp4", "gif", "png", "npz"], fps=10, views=views)
    store.remove()
    assert not store.folder.exists()
    return files(folder)


def test_broken_off_and_shared_renderings_give_the_same_bytes(tmp_path: Path) -> None:
    whole = film(tmp_path / "whole", [Share()])
    assert {name for name in whole if "/" not in name} == {
        "film.npz",
        *(f"film{suffix}.{f}" for suffix in ("", "_depth", "_opacity", "_motion", "_compare") for f in ("mp4", "gif")),
    }
    assert film(tmp_path / "resumed", [Share()], stop_after=2) == whole
    assert film(tmp_path / "shared", [Share(1, 2), Share(0, 2)]) == whole


@pytest.mark.parametrize("exact", [False, True])
def test_all_views_decide_what_frames_share_unless_all_is_to_be_exact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exact: bool
) -> None:
    renderer, views, asked = make_renderer(), some_views(3), []
    monkeypatch.setattr(Renderer, "for_sequence", lambda own, count: asked.append(count) or own)
    render_frames_to(FrameStore(tmp_path, 3), renderer, views, ["rgb"], share=Share(1, 2), exact=exact)
    assert asked == ([] if exact else [3])


KILLED = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_films import FrameStore, make_renderer, render_frames_to, some_views
def kill(index):
    if index == 2:
        os.kill(os.getpid(), signal.SIGKILL)
render_frames_to(FrameStore(Path(sys.argv[1]), 5), make_renderer(), some_views(5), ["rgb"], on_frame=kill)
"""


def test_a_killed_process_loses_no_finished_frame(tmp_path: Path) -> None:
    here = str(Path(__file__).parent)
    done = subprocess.run([sys.executable, "-c", KILLED, tmp_path / "frames", here], check=False, env=os.environ)
    assert done.returncode == -signal.SIGKILL
    store, views = FrameStore(tmp_path / "frames", 5), some_views(5)
    assert store.missing() == [3, 4]
    before = {i: store.path(i).stat().st_mtime_ns for i in range(3)}
    assert render_frames_to(store, make_renderer(), views, ["rgb"]) == 2
    assert {i: store.path(i).stat().st_mtime_ns for i in range(3)} == before
    fresh = FrameStore(tmp_path / "fresh", 5)
    render_frames_to(fresh, make_renderer(), views, ["rgb"])
    assert files(store.folder) == files(fresh.folder)


def test_raw_arrays_hold_every_frame_and_camera(tmp_path: Path) -> None:
    renderer, views = make_renderer(), some_views(3)
    store = FrameStore(tmp_path / "frames", 3)
    render_frames_to(store, renderer, views, ["rgb", "depth"])
    (path,) = write_films(store, tmp_path / "film", ["rgb", "depth"], ["npz"], fps=12, views=views)
    with np.load(path) as arrays:
        assert set(arrays.files) == {"rgb", "depth", "opacity", "fps", "times", "poses", "intrinsics"}
        assert arrays["rgb"].shape == (3, 16, 20, 3)
        assert arrays["fps"] == 12
        for i, view in enumerate(views):
            np.testing.assert_array_equal(arrays["depth"][i], renderer.render_image(view.camera, view.time).depth)
            np.testing.assert_array_equal(arrays["poses"][i], view.camera.pose)
            assert arrays["times"][i] == view.time
        focal = INTRINSICS.focal_x
        np.testing.assert_allclose(arrays["intrinsics"], [[20, 16, focal, focal, 10, 8]] * 3)


def test_damaged_and_missing_frames_are_named(tmp_path: Path) -> None:
    store = FrameStore(tmp_path, 2)
    store.write(0, {"rgb": np.zeros((2, 2, 3), np.uint8)})
    with pytest.raises(ValueError, match=r"frame_00001\.npz: not a readable frame"):
        list(store)
    store.write(1, {"rgb": np.zeros((2, 3, 3), np.uint8)})
    with pytest.raises(ValueError, match=r"frame_00001\.npz: rgb must be uint8"):
        write_npz(store, tmp_path / "a.npz", {})
    assert not (tmp_path / "a.npz").exists()
    store.path(1).write_bytes(store.path(1).read_bytes()[:100])
    with pytest.raises(ValueError, match=r"frame_00001\.npz: not a readable frame"):
        store.read(1)


def test_digest_tells_sequences_apart() -> None:
    views, facts = some_views(3), {"model": "abc"}
    names = [
        sequence_digest(views, facts),
        sequence_digest(views[:2], facts),
        sequence_digest(views, {"model": "abd"}),
        sequence_digest([*views[:2], View(views[2].camera, 0.9)], facts),
        sequence_digest([*views[:2], View(views[1].camera, views[2].time)], facts),
    ]
    assert len(set(names)) == 5
    assert sequence_digest(some_views(3), facts) == names[0]


def test_a_view_outside_the_time_range_is_refused() -> None:
    with pytest.raises(ValueError, match=r"time must be in \[0, 1\], got 1.5"):
        View(some_views(1)[0].camera, 1.5)
    with pytest.raises(ValueError, match="rank must be in"):
        Share(2, 2)


def test_films_have_the_frames(tmp_path: Path) -> None:
    store = FrameStore(tmp_path / "frames", 4)
    render_frames_to(store, make_renderer(), some_views(4), ["depth"])
    (path,) = write_films(store, tmp_path / "film", ["depth"], ["mp4"], fps=10)
    assert path.name == "film.mp4"
    shape = iio.imread(path).shape
    assert shape[:2] == (4, 16)
    assert shape[2] > 20  # the scale stands beside the picture


def test_a_frame_that_cannot_be_written_ends_the_rendering(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write, told = FrameStore.write, []

    def failing(self: FrameStore, index: int, layers: dict) -> None:
        if index == 1:
            raise OSError("no space left")
        write(self, index, layers)

    monkeypatch.setattr(FrameStore, "write", failing)
    store = FrameStore(tmp_path, 4)
    with pytest.raises(OSError, match="no space left"):
        render_frames_to(store, make_renderer(), some_views(4), ["rgb"], on_frame=told.append)
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
    store = FrameStore(tmp_path, 4)
    with pytest.raises(FloatingPointError, match="NaN"):
        render_frames_to(store, make_renderer(), views, ["rgb"], on_frame=told.append)
    assert told == [0, 1]
    assert store.missing() == [2, 3]
