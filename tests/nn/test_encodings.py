"""Encodings against loops."""

import math

import numpy as np
import pytest
import torch
from reference import sinusoidal

from dnerf.nn.encodings import SinusoidalEncoding, TimeEncoding

PLACES = torch.zeros(1, 3)  # of cameras, which do not matter here


@pytest.mark.parametrize("num_dims", [1, 3])
@pytest.mark.parametrize("num_frequencies", [0, 1, 10])
def test_sinusoidal_encoding_agrees_with_a_loop(num_dims: int, num_frequencies: int) -> None:
    encoding = SinusoidalEncoding(num_dims, num_frequencies)
    values = 2 * torch.randn(20, num_dims, dtype=torch.float64)
    encoded = encoding(values)
    expected = [sinusoidal(row, num_frequencies, [1.0] * num_frequencies) for row in values.tolist()]
    assert encoded.dtype == torch.float64
    assert encoded.shape == (20, encoding.out_features)
    torch.testing.assert_close(encoded, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-15)


@pytest.mark.parametrize("progress", [0.0, 0.1, 0.25, 0.37, 0.5, 0.9, 1.0, 1.5])
def test_window_opens_octave_by_octave(progress: float) -> None:
    encoding = SinusoidalEncoding(2, 4, window_end=0.5)
    encoding.set_progress(progress)
    alpha = 4 * min(progress / 0.5, 1)
    window = [(1 - math.cos(math.pi * min(max(alpha - k, 0), 1))) / 2 for k in range(4)]
    values = torch.randn(5, 2, dtype=torch.float64)
    expected = torch.tensor([sinusoidal(row, 4, window) for row in values.tolist()], dtype=torch.float64)
    # The window is kept in float32.
    torch.testing.assert_close(encoding(values), expected, rtol=0, atol=1e-6)


def test_window_is_saved_with_the_model() -> None:
    trained = SinusoidalEncoding(3, 6, window_end=0.8)
    trained.set_progress(0.3)
    loaded = SinusoidalEncoding(3, 6, window_end=0.8)
    loaded.load_state_dict(trained.state_dict())
    values = torch.randn(7, 3)
    assert torch.equal(loaded(values), trained(values))


def test_progress_changes_nothing_without_a_window() -> None:
    encoding, values = SinusoidalEncoding(3, 6), torch.randn(7, 3)
    before = encoding(values)
    encoding.set_progress(0.0)
    assert torch.equal(encoding(values), before)
    assert encoding.state_dict() == {}


def with_embeddings(num_embeddings: int = 5, num_features: int = 2) -> TimeEncoding:
    encoding = TimeEncoding(3, num_embeddings, num_features).double()
    assert encoding.embeddings is not None
    torch.nn.init.normal_(encoding.embeddings)
    return encoding


def test_features_of_embeddings_are_linear_in_between() -> None:
    encoding, times = with_embeddings(), torch.linspace(-0.2, 1.2, 57, dtype=torch.float64)[:, None]
    encoded = encoding(times)
    assert encoded.shape == (57, encoding.out_features)
    assert torch.equal(encoded[:, :7], SinusoidalEncoding(1, 3)(times))
    assert encoding.embeddings is not None
    embeddings = encoding.embeddings.detach().numpy()
    expected = [np.interp(times[:, 0], np.linspace(0, 1, 5), column) for column in embeddings.T]  # ends are held
    torch.testing.assert_close(encoded[:, 7:].detach(), torch.from_numpy(np.stack(expected, -1)), rtol=0, atol=1e-14)


def test_a_time_teaches_the_two_embeddings_beside_it() -> None:
    encoding = with_embeddings()
    encoding(torch.tensor([[[0.6]], [[0.7]]], dtype=torch.float64)).sum().backward()
    assert encoding.embeddings is not None
    assert encoding.embeddings.grad is not None
    expected = torch.tensor([0, 0, 0.6 + 0.2, 0.4 + 0.8, 0], dtype=torch.float64)[:, None].expand(5, 2)
    torch.testing.assert_close(encoding.embeddings.grad, expected, rtol=0, atol=1e-12)


def test_embeddings_say_nothing_until_they_have_learnt() -> None:
    encoding, times = TimeEncoding(3, 100, 4), torch.rand(20, 1)
    assert torch.count_nonzero(encoding(times)[:, 7:]) == 0
    assert torch.equal(TimeEncoding(3)(times), SinusoidalEncoding(1, 3)(times))
    assert TimeEncoding(3).state_dict() == {}  # as models of before there were any


@pytest.mark.parametrize(("times", "expected"), [
    (torch.linspace(0, 1, 50), 25),
    (torch.linspace(0, 1, 400), 100),  # all there are
    (torch.linspace(0, 1, 7).repeat(20), 7),  # times that twenty cameras share
    (torch.zeros(30), 2),
    (torch.zeros(1), 2),
])  # fmt: skip
def test_half_as_many_embeddings_as_frames_are_used(times: torch.Tensor, expected: int) -> None:
    encoding = TimeEncoding(3, 100, 2).double()
    encoding.see(times, PLACES)
    assert encoding.num_used.item() == expected
    few = with_embeddings(expected)
    with torch.no_grad():
        encoding.embeddings.copy_(torch.randn(100, 2))
        few.embeddings.copy_(encoding.embeddings[:expected])
    instants = torch.linspace(-0.1, 1.1, 200, dtype=torch.float64)[:, None]
    torch.testing.assert_close(encoding(instants), few(instants), rtol=0, atol=1e-12)
    torch.testing.assert_close(encoding.roughness(), few.roughness())
    (encoding(instants).sum() + encoding.roughness()).backward()
    assert torch.count_nonzero(encoding.embeddings.grad[expected:]) == 0
    again = with_embeddings(100)
    again.load_state_dict(encoding.state_dict())
    assert torch.equal(again(instants), encoding(instants))


def test_what_embeddings_have_learnt_stays_with_more_frames_and_with_fewer() -> None:
    encoding, instants = TimeEncoding(3, 100, 2).double(), torch.linspace(-0.1, 1.1, 200, dtype=torch.float64)[:, None]
    encoding.see(torch.linspace(0, 1, 50), PLACES)
    with torch.no_grad():
        encoding.embeddings.copy_(torch.randn(100, 2))
    before = encoding(instants)
    for num_frames, expected in ((98, 49), (10, 49), (1, 49), (400, 100)):  # 49: every second where one was
        encoding.see(torch.linspace(0, 1, num_frames), PLACES)
        assert encoding.num_used.item() == expected
        if expected == 49:
            torch.testing.assert_close(encoding(instants), before, rtol=0, atol=1e-12)


def test_without_embeddings_there_is_nothing_to_tell() -> None:
    encoding = TimeEncoding(3)
    encoding.see(torch.linspace(0, 1, 50), PLACES)
    assert encoding.state_dict() == {}


@pytest.mark.parametrize("shape", [(0, 1), (3, 0, 1), (1,), (2, 3, 1)])
def test_times_of_any_number_are_encoded(shape: tuple[int, ...]) -> None:
    assert with_embeddings()(torch.rand(shape, dtype=torch.float64)).shape == (*shape[:-1], 9)


def test_features_pass_gradients_to_times() -> None:
    encoding = with_embeddings()
    times = torch.tensor([[0.1], [0.33], [0.9]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(encoding, (times,))


def test_a_time_that_is_no_number_stays_none() -> None:
    assert with_embeddings()(torch.tensor([[math.nan], [0.5]], dtype=torch.float64)).isnan().tolist() == [
        [True] * 9, [False] * 9,
    ]  # fmt: skip


@pytest.mark.parametrize(("arguments", "expected"), [
    ((3, 1), "num_embeddings must be 0 or at least 2, got 1"),
    ((3, -2), "num_embeddings must be 0 or at least 2, got -2"),
    ((3, 2.5), "num_embeddings must be a whole number, got 2.5"), ((3, 5, 0), "num_features must be > 0"),
])  # fmt: skip
def test_embeddings_out_of_range_are_refused(arguments: tuple[int, ...], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        TimeEncoding(*arguments)


def test_gradcheck_of_sinusoidal_encoding() -> None:
    encoding = SinusoidalEncoding(3, 3, window_end=1.0)
    encoding.set_progress(0.7)
    assert torch.autograd.gradcheck(encoding, (torch.randn(2, 3, dtype=torch.float64, requires_grad=True),))


@pytest.mark.parametrize(("arguments", "message"), [
    ({"num_dims": 0, "num_frequencies": 4}, "num_dims must be > 0"),
    ({"num_dims": 3, "num_frequencies": -1}, "num_frequencies must be >= 0"),
    ({"num_dims": 3, "num_frequencies": 4, "window_end": 0.0}, "window_end must be in"),
    ({"num_dims": 3, "num_frequencies": 4, "window_end": 1.1}, "window_end must be in"),
    ({"num_dims": 3, "num_frequencies": 4, "window_end": math.nan}, "window_end must be in"),
])  # fmt: skip
def test_sinusoidal_encoding_refuses_bad_arguments(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SinusoidalEncoding(**arguments)


def test_values_of_another_size_are_named() -> None:
    with pytest.raises(ValueError, match=r"values must have shape \(..., 1\), got \(5, 2\)"):
        SinusoidalEncoding(1, 4)(torch.zeros(5, 2))
