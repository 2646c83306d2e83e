"""Errors of recovered motion are those of the truth."""

import math

import pytest
import torch
from torch import Tensor

from benchmarks.endpoint_rows import endpoint_rows, surface_points
from dnerf.data.normalization import Similarity
from dnerf.deformations import IdentityDeformation
from dnerf.scenes import make_scene


def test_the_scene_itself_has_no_end_point_error() -> None:
    scene = make_scene("walker")
    for row in endpoint_rows(scene, scene, num_points=200, times=(0.2, 0.5)):
        assert row["mean_error"] == 0
        assert row["moved"] > 0.01


def test_a_model_that_stands_still_is_wrong_by_the_motion() -> None:
    scene = make_scene("orbiting_balls")
    rows = endpoint_rows(IdentityDeformation(), scene, num_points=300, times=(0.25,))
    assert math.isclose(rows[0]["mean_error"], rows[0]["moved"], rel_tol=1e-5)
    assert rows[0]["moved"] > 0.3


def test_errors_are_in_the_scene_s_units_whatever_the_model_s() -> None:
    scene = make_scene("walker")

    class Still(IdentityDeformation):
        """Says where it was asked about."""

        places: Tensor

        def forward(self, positions: Tensor, times: Tensor) -> Tensor:
            self.places = positions
            return positions

    own, small = Still(), Still()
    similarity = Similarity(0.25, center=(1.0, 2.0, 3.0))
    rows = [endpoint_rows(own, scene, num_points=300, times=(0.25,))]
    rows.append(endpoint_rows(small, scene, num_points=300, times=(0.25,), similarity=similarity))
    assert rows[1][0]["mean_error"] == pytest.approx(rows[0][0]["mean_error"], rel=1e-4)
    torch.testing.assert_close(small.places, similarity.positions_to_world(own.places).float())


def test_points_are_in_one_body_near_its_surface() -> None:
    scene = make_scene("walker")
    points = surface_points(scene, 0.3, 300, depth=0.02, seed=0)
    times = torch.full((len(points),), 0.3)
    assert torch.all(scene.contains(points, times).sum(-1) == 1)

    def free(directions: Tensor) -> Tensor:
        return scene.body_indices(points + 0.02 * directions, times) < 0

    tried = torch.stack([free(torch.nn.functional.normalize(torch.randn(len(points), 3), dim=-1)) for _ in range(60)])
    # A point just below a flat surface sees it in a few directions only.
    assert tried.any(0).float().mean() > 0.8


def test_a_scene_without_motion_is_named() -> None:
    scene = make_scene("static")
    with pytest.raises(ValueError, match=r"points that move by 0\.01"):
        endpoint_rows(scene, scene, num_points=50)


def test_times_at_which_bodies_hide_in_each_other_are_left_out() -> None:
    scene = make_scene("merging_balls")  # at 1/2 one ball is where the other is
    assert [row["time"] for row in endpoint_rows(scene, scene, num_points=100, times=(0.25, 0.5, 1.0))] == [0.25, 1.0]
    with pytest.raises(ValueError, match=r"in one body only at one of the times \[0\.5\]"):
        endpoint_rows(scene, scene, num_points=100, times=(0.5,))
