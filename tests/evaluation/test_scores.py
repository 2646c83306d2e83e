from dataclasses import replace

import pytest
import torch

from dnerf.core.backgrounds import ConstantBackground
from dnerf.data import SyntheticData
from dnerf.evaluation import FrameScore, evaluate, psnr, scores_by_time, spread_indices, ssim
from dnerf.evaluation.scores import MAX_PSNR
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.scenes import make_scene


@pytest.fixture(scope="module")
def truth():
    """Frames and a renderer of the very scene they show, so that scores are known to be good."""
    source = SyntheticData(make_scene("pulsing_fog"), 16, num_test=5)
    return source.frames("test"), Renderer(source.scene, StratifiedSampler(256, source.world().box))


def test_the_scene_itself_scores_nearly_perfectly_and_mode_is_restored(truth):
    frames, renderer = truth
    scores = evaluate(renderer, frames, "test")
    # 256 equal intervals over about 4 units miss a fog ball's surface by at most 0.008 units of density 3.
    assert scores.psnr > 35
    assert scores.ssim > 0.99
    assert [f.index for f in scores.frames] == [0, 1, 2, 3, 4]
    assert scores.psnr == pytest.approx(sum(f.psnr for f in scores.frames) / 5)
    assert [f.index for f in evaluate(renderer, frames, max_frames=3).frames] == [0, 2, 4]
    renderer.train()
    evaluate(renderer, frames, max_frames=1)
    assert renderer.training
    renderer.eval()
    evaluate(renderer, frames, max_frames=1)
    assert not renderer.training


def test_scores_are_those_of_the_images_on_the_renderers_background(truth):
    frames, renderer = truth
    black = Renderer(renderer.field, renderer.sampler, ConstantBackground("black"))
    given = []
    evaluate(black, frames, on_frame=lambda *scored: given.append(scored))
    for score, prediction, target in given:
        assert torch.equal(target, frames.image(score.index, (0.0, 0.0, 0.0)))
        assert score.psnr == psnr(prediction, target)
        assert score.ssim == ssim(prediction, target)
        assert score.time == float(frames.times[score.index])


def test_scores_leave_out_what_does_not_count(truth):
    frames, renderer = truth
    known = torch.ones(5, 16, 16, dtype=torch.bool)
    known[:, 4:9, 3:12] = False
    spoilt = frames.images.clone()
    spoilt[~known] = 255
    for images in (frames.images, spoilt):
        scored = evaluate(renderer, replace(frames, images=images, is_known=known.flatten()))
        image = renderer.render_image(frames.camera(2), float(frames.times[2])).rgb.clamp(0, 1)
        expected = psnr(image[known[2]], frames.image(2, renderer.plain_background())[known[2]])
        assert scored.frames[2].psnr == pytest.approx(expected, abs=1e-4)
        assert scored.ssim > 0.98
    assert evaluate(renderer, replace(frames, images=spoilt)).psnr < 20


def test_identical_images_get_a_finite_score(truth):
    _, renderer = truth

    class Nothing(type(renderer.field)):
        def density(self, positions, times):
            return torch.zeros_like(times)

        def forward(self, positions, directions, times):
            output = super().forward(positions, directions, times)
            return type(output)(torch.zeros_like(times), output.rgb)

    nothing = Nothing(renderer.field.bodies, renderer.field.box)
    white = SyntheticData(nothing, 16, num_test=1).frames("test")
    blank = type(white)(torch.zeros_like(white.images), white.poses, white.times, white.intrinsics)
    assert evaluate(Renderer(nothing, renderer.sampler), blank).psnr == MAX_PSNR


@pytest.mark.parametrize(
    ("count", "most", "indices"),
    [(5, None, [0, 1, 2, 3, 4]), (5, 9, [0, 1, 2, 3, 4]), (20, 4, [0, 6, 13, 19]), (7, 1, [0]), (3, 2, [0, 2])],
)
def test_spread_indices(count, most, indices):
    assert spread_indices(count, most) == indices


def test_no_frames_is_refused():
    with pytest.raises(ValueError, match="max_frames must be > 0"):
        spread_indices(5, 0)


def test_scores_are_split_at_the_last_training_time():
    frames = [
        FrameScore(i, time, psnr, 0.5 + 0.1 * i) for i, (time, psnr) in enumerate([(0.1, 30), (0.8, 20), (0.9, 10)])
    ]
    groups = scores_by_time(frames, 0.8)
    assert groups["interpolation"] == {"num_frames": 2, "psnr": 25, "ssim": pytest.approx(0.55)}
    assert groups["extrapolation"] == {"num_frames": 1, "psnr": 10, "ssim": pytest.approx(0.7)}
    assert scores_by_time(frames, 1.0)["extrapolation"] == {"num_frames": 0, "psnr": None, "ssim": None}
