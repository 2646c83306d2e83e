"""Images in a fixed number of places: the same as others, in any chunks, for any view and time."""

import copy
import pickle
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch
from device_waits import DeviceWaits
from fixed_models import small_renderer
from recorded_graphs import recorded_graphs
from torch import Tensor

from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.core.rays import Rays
from dnerf.rendering.frame_graphs import MOST_VIEWS, FrameGraphs, Show
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import Capacity

SIZE = Intrinsics(24, 20, 30.0, 30.0)


def camera(device: torch.device, angle: float = 0.0) -> Camera:
    return Camera(SIZE, look_at((4.0, angle, 1.0)).to(device))


def trained(device: str = "cpu", *, graphs: bool = False) -> Renderer:
    """A model whose occupied cells are those around a ball."""
    renderer = small_renderer(device=device, graphs=graphs, render_dilation=0)
    field = renderer.field

    def density(positions: Tensor, times: Tensor) -> Tensor:
        return 20 * torch.sigmoid(20 * (0.7 - (positions - 0.2 * times[..., None]).norm(dim=-1)))

    kept = field.canonical.density  # type: ignore[union-attr,operator]
    field.canonical.density = density  # type: ignore[union-attr,method-assign,assignment]
    renderer.sampler.grid.fill(field)  # type: ignore[operator]
    field.canonical.density = kept  # type: ignore[union-attr,method-assign]
    return renderer.eval()


def shown_by(renderer: Renderer) -> Show:
    """What a renderer shows in a fixed number of places."""

    def show(rays: Rays, marched: int, kept: int) -> tuple[Tensor, Tensor]:
        shown = renderer(rays, capacity=Capacity(marched, kept, renderer.stop_transmittance))
        columns = torch.cat([shown.rgb, shown.opacity[:, None], shown.depth[:, None]], dim=-1)
        return columns, shown.samples.wanted

    return show


def image_of(graphs: FrameGraphs, renderer: Renderer, view: Camera, time: float, chunk: int = 10000) -> Tensor:
    return graphs.image(view, time, chunk=chunk, way=0, memory=0, show=shown_by(renderer))


@pytest.mark.parametrize("chunk", [480, 100, 7])
def test_images_are_those_of_walked_rays(chunk: int) -> None:
    renderer = trained()
    graphs = FrameGraphs(renderer.device)
    for time, angle in ((0.0, 0.0), (0.9, 2.0)):
        view = camera(renderer.device, angle)
        image = renderer.render_image(view, time)
        found = image_of(graphs, renderer, view, time, chunk).reshape(20, 24, 5)
        assert float(image.opacity.max()) > 0.2
        # Either leaves out intervals whose weight is as little as 1e-3, which not all are the same.
        torch.testing.assert_close(found[..., :3], image.rgb, rtol=0, atol=0.01)
        torch.testing.assert_close(found[..., 3], image.opacity, rtol=0, atol=0.01)


def test_sizes_grow_until_all_fits() -> None:
    tried: list[tuple[int, int]] = []

    def show(rays: Rays, marched: int, kept: int) -> tuple[Tensor, Tensor]:
        tried.append((marched, kept))
        wanted = 50000 if float(rays.times[0]) > 0.5 else 10
        return rays.times[:, None].clone(), torch.tensor([wanted, 5])

    graphs = FrameGraphs(torch.device("cpu"))
    for time in (0.0, 0.1, 0.9, 0.2):
        image = graphs.image(camera(torch.device("cpu")), time, chunk=1000, way=0, memory=0, show=show)
        assert image.shape == (480, 1)
        torch.testing.assert_close(image, torch.full_like(image, time))
    assert tried[0] == (1920, 1920)  # a guess
    assert tried[1] == (2048, 2048)
    assert tried[2] == (2048, 2048)  # not enough: shown again
    assert tried[3][0] > 50000
    assert tried[4] == tried[3]


def test_few_views_are_kept() -> None:
    renderer = trained()
    graphs = FrameGraphs(renderer.device)
    for focal in range(30, 40):
        view = replace(camera(renderer.device), intrinsics=Intrinsics(8, 6, float(focal), float(focal)))
        assert image_of(graphs, renderer, view, 0.5).shape == (48, 5)
        assert len(graphs._sizes) <= MOST_VIEWS


def test_ways_to_show_a_view_are_kept_until_tensors_move() -> None:
    tried: list[tuple[int, int]] = []

    def show(rays: Rays, marched: int, kept: int) -> tuple[Tensor, Tensor]:
        tried.append((marched, kept))
        return rays.times[:, None].clone(), torch.tensor([5000, 5000])

    graphs, view = FrameGraphs(torch.device("cpu")), camera(torch.device("cpu"))
    for way, memory in ((3, 0), (1, 0), (3, 0), (1, 0), (3, 1)):
        graphs.image(view, 0.5, chunk=1000, way=way, memory=memory, show=show)
    guess, known = (1920, 1920), (8192, 8192)
    assert tried == [guess, known, guess, known, known, known, guess, known]


def test_an_image_waits_once() -> None:
    renderer = trained()
    graphs = FrameGraphs(renderer.device)
    inside: list[str] = []

    def show(rays: Rays, marched: int, kept: int) -> tuple[Tensor, Tensor]:
        with DeviceWaits() as waits:
            shown = shown_by(renderer)(rays, marched, kept)
        inside.extend(waits.found)
        return shown

    triton = pytest.importorskip("triton")
    if not triton.knobs.runtime.interpret:
        pytest.skip("triton was imported before it could be told to interpret")
    from dnerf import kernels

    with kernels.use_backend("triton"):
        view = replace(camera(renderer.device), intrinsics=Intrinsics(4, 3, 5.0, 5.0))
        graphs.image(view, 0.5, chunk=100, way=0, memory=0, show=show)
        inside.clear()
        graphs.image(view, 0.5, chunk=100, way=0, memory=0, show=show)
    assert inside == []


def test_copies_record_anew() -> None:
    """Graphs cannot be copied: they refer to one model's memory."""
    renderer = trained()
    renderer._frames = FrameGraphs(renderer.device)
    image_of(renderer._frames, renderer, camera(renderer.device), 0.5)
    assert renderer._frames._sizes
    for copied in (copy.deepcopy(renderer), pickle.loads(pickle.dumps(renderer._frames))):  # noqa: S301
        frames = copied._frames if isinstance(copied, Renderer) else copied
        assert isinstance(frames, FrameGraphs)
        assert not frames._sizes


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_replayed_images_are_those_of_walked_rays(device: str) -> None:
    renderer, plain = trained(device, graphs=True), trained(device)
    with nullcontext() if device == "cuda" else recorded_graphs():
        for time, angle in ((0.0, 0.0), (0.3, 1.0), (0.6, 1.5), (0.9, 2.0)):
            view = camera(renderer.device, angle)
            image, expected = renderer.render_image(view, time), plain.render_image(view, time)
            torch.testing.assert_close(image.rgb, expected.rgb, rtol=0, atol=0.01)
        assert float(image.opacity.max()) > 0.2
        with torch.no_grad():
            for parameter in renderer.field.canonical.parameters():  # type: ignore[union-attr]
                parameter.zero_()
        assert float((renderer.render_image(view, 0.9).rgb - image.rgb).abs().max()) > 0.01
        moved = renderer.to(torch.float64).to(torch.float32) if device == "cpu" else renderer.to("cpu").to(device)
        assert torch.isfinite(moved.render_image(view, 0.9).rgb).all()
