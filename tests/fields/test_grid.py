"""The grid field: its box, and parts that do not exist unless asked for."""

import pytest
import torch

from dnerf.fields import GridField

BOX = [[-1.0, 0.0, 2.0], [1.0, 1.0, 6.0]]


def small(**options: object) -> GridField:
    field = GridField(BOX, (4, 8), 2, hidden_features=16, **options)  # type: ignore[arg-type]
    torch.nn.init.normal_(field.table)
    return field


def test_positions_outside_the_box_see_its_nearest_face() -> None:
    field, times = small(), torch.zeros(100)
    corners = torch.tensor(BOX)
    positions = corners[0] + (corners[1] - corners[0]) * (3 * torch.rand(100, 3) - 1)
    inside = torch.minimum(torch.maximum(positions, corners[0]), corners[1])
    torch.testing.assert_close(field.density(positions, times), field.density(inside, times), rtol=1e-4, atol=0)


def test_the_grid_spans_the_box() -> None:
    """Along every axis the density varies between the faces and the middle, on both sides."""
    field, corners = small(), torch.tensor(BOX)
    for axis in range(3):
        unit = torch.full((9, 3), 0.4)
        unit[:, axis] = torch.linspace(0, 1, 9)
        density = field.density(corners[0] + unit * (corners[1] - corners[0]), torch.zeros(9))
        assert (density.diff().abs() > 1e-6).all()


def test_cells_are_cubes() -> None:
    field = small()
    # Sides 2, 1, 4 at 4 and 8 cells along the longest; a level has one vertex more than cells along each axis.
    assert field.table.shape[0] == 3 * 2 * 5 + 5 * 3 * 9


def test_parts_that_are_not_asked_for_do_not_exist() -> None:
    def keys(**options: object) -> set[str]:
        return {name.split(".")[0] for name, _ in small(**options).named_modules() if name}

    assert keys() == {"head"}
    assert keys(time_frequencies=2) == {"head", "encode_times"}
    assert keys(view_degree=1) == {"head", "encode_directions", "to_rgb"}


def test_time_features_let_a_place_change_with_time() -> None:
    positions = torch.rand(20, 3) + torch.tensor([0.0, 0.0, 3.0])
    for options, changes in (({}, False), ({"time_frequencies": 2}, True)):
        field = small(**options)
        first, last = field.density(positions, torch.zeros(20)), field.density(positions, torch.ones(20))
        assert torch.equal(first, last) != changes


@pytest.mark.parametrize(
    ("box", "options", "message"),
    [
        ([[0, 0, 0], [1, 0, 1]], {}, "box must have finite corners"),
        (BOX, {"num_features": 0}, "num_features must be > 0"),
        (BOX, {"resolutions": ()}, "resolutions"),
    ],
)
def test_bad_grids_are_refused(box: list, options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GridField(box, **options)
