import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kernels.test_march import BOX, assert_same, grid, rays

from dnerf import kernels
from dnerf.kernels import march, march_to_size
from dnerf.kernels.march_to_size import fitted

STEP = torch.tensor(0.07)


def on(device, arguments):
    return {name: value.to(device) for name, value in arguments.items()}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [1, 20, 60, 500])
def test_compiled_equals_definition(compiled, size, dtype):
    """All fit, some rays do not, none does."""
    arguments = rays(120, dtype=dtype) | {"occupancy": grid(), "aabb": BOX.to(dtype)}
    with kernels.use_backend("reference"):
        marched = march(**arguments, step=float(STEP.to(dtype)))
        expected, wanted = fitted(marched, size)
    actual, found = march_to_size(**on(compiled, arguments), step=STEP.to(compiled, dtype), size=size)
    assert_same(actual, expected)
    assert int(found) == int(wanted) == len(marched.starts) > 60
    is_real = expected.ends > expected.starts
    assert is_real.sum() == len(marched.starts) if size == 500 else is_real.sum() <= size


@given(seed=st.integers(0, 99), share=st.sampled_from([0.0, 0.01, 0.3]), size=st.integers(1, 300))
def test_what_fits_is_what_is_marched(seed, share, size):
    arguments = rays(50, seed) | {"occupancy": grid(share=share, seed=seed), "aabb": BOX}
    marched = march(**arguments, step=0.07)
    actual, wanted = march_to_size(**arguments, step=STEP, size=size)
    assert int(wanted) == len(marched.starts)
    last = int((marched.offsets <= size).sum()) - 1  # rays that fit
    is_real = actual.ends > actual.starts
    for name in ("starts", "ends", "ray_indices"):
        assert torch.equal(getattr(actual, name)[is_real], getattr(marched, name)[: marched.offsets[last]])
    assert int(actual.offsets[-1]) == size == len(actual.starts)


def test_registered_op(compiled):
    arguments = on(compiled, rays(20) | {"occupancy": grid(), "aabb": BOX})
    if compiled == "cpu" and kernels.get_backend() == "numba":
        pytest.skip("marched by `march`")
    columns = [arguments[name] for name in ("origins", "directions", "near", "far", "times", "jitter")]
    op = torch.ops.dnerf.march_to_size
    torch.library.opcheck(op, (arguments["occupancy"], columns, arguments["aabb"], STEP.to(compiled), 100))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"size": 0}, "rays and places for samples, got 30 and 0"),
        ({"step": torch.ones(1)}, "step must be a scalar"),
        ({"near": torch.zeros(3)}, "near must have shape"),
    ],
)
def test_wrong_arguments(changes, message):
    arguments = rays(30) | {"occupancy": grid(), "aabb": BOX, "step": STEP, "size": 10} | changes
    with pytest.raises(ValueError, match=message):
        march_to_size(**arguments)


def test_no_rays():
    with pytest.raises(ValueError, match="got 0 and 10"):
        march_to_size(**rays(0), occupancy=grid(), aabb=BOX, step=STEP, size=10)
