"""Layers of a ReLU network, one after the other."""

import logging
from collections.abc import Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor

from .backend import choose, run_compiled
from .op import op

logger = logging.getLogger(__name__)

# oneDNN's ReLU makes zeros of NaNs; with a slope below zero, however small, it keeps them.
SLOPE = 1e-30
PARTS = 8  # of a sum over rows: several sums at once are quicker than one of so many terms


def relu_layers(inputs: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> Tensor:
    """ReLU(W x + b), layer after layer.

    Under autocast to bfloat16, on CPUs that have it, oneDNN adds the bias and cuts off what is negative while it
    multiplies: one pass over memory instead of three. Sums are then rounded in another order, and what was negative is
    -`SLOPE` times its size instead of zero. CPUs that multiply vectors in bfloat16, but no tiles (AMX), do without
    oneDNN where layers' widths are multiples of 16: a few hundred rows go through all layers in the nearest caches. So
    do several layers in float32 without gradients.

    Args:
        inputs: (..., in_features).
        weights, biases: of each layer, at least one, (out_features, in_features) and (out_features,).

    Returns:
        (..., out_features of the last layer), differentiable to any order.
    """
    # Inputs that are rounded already are served as those that are not.
    is_rounded, dtype = is_bfloat16_wanted(inputs), torch.float32
    backend = choose(inputs.new_empty(0, dtype=dtype)) if is_rounded or is_plain(inputs) else "reference"
    is_served = is_rounded or (backend == "numba" and run_compiled("relu_layers", "serves", inputs, weights))
    if backend == "reference" or not is_served:
        return relu_layers_reference(inputs, weights, biases)
    dtype = torch.bfloat16 if is_rounded else dtype
    weights, biases = [p.to(dtype) for p in weights], [p.to(dtype) for p in biases]
    outputs = inputs.reshape(-1, inputs.shape[-1]).to(dtype)
    if torch.is_grad_enabled():
        outputs = _Layers.apply(outputs, *weights, *biases)
    else:
        outputs = _run(outputs, weights, biases, is_kept=False)[-1]
    return outputs.reshape(*inputs.shape[:-1], len(biases[-1]))


def relu_layers_reference(inputs: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> Tensor:
    """The definition of `relu_layers` in plain torch."""
    for weight, bias in zip(weights, biases, strict=True):
        inputs = torch.relu_(torch.nn.functional.linear(inputs, weight, bias))
    return inputs


def is_bfloat16_wanted(inputs: Tensor) -> bool:
    """Whether layers round such inputs to bfloat16: under autocast, where there are instructions for it."""
    device = inputs.device.type
    if device not in ("cpu", "cuda") or inputs.dtype == torch.float64 or not torch.is_autocast_enabled(device):
        return False
    return has_bfloat16(device) and torch.get_autocast_dtype(device) == torch.bfloat16


def is_plain(inputs: Tensor) -> bool:
    """Whether layers keep such inputs in float32, on the CPU."""
    return inputs.is_cpu and inputs.dtype == torch.float32 and not torch.is_autocast_enabled("cpu")


@cache
def has_bfloat16(device: str) -> bool:
    """Whether a type of device multiplies in bfloat16; to emulate it takes many times as long as float32."""
    if device == "cuda":
        found = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        # With AVX-512 alone oneDNN emulates them, which takes twice as long as float32 (its issue 493).
        is_emulated = torch.cpu._is_avx512_supported() and not torch.cpu._is_avx512_bf16_supported()
        has_onednn = torch.backends.mkldnn.is_available() and not is_emulated
        found = device != "cpu" or bool(has_onednn and torch.ops.mkldnn._is_mkldnn_bf16_supported())
    if not found:
        logger.info("this processor has no instructions for bfloat16: all is computed in float32, which is slower")
    return found


def _run(inputs: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], *, is_kept: bool) -> list[Tensor]:
    """The last layer's outputs, or those of all."""
    if inputs.is_cpu and run_compiled("relu_layers", "serves", inputs, weights):
        return _relu_layers(inputs, list(weights), list(biases), is_kept)
    outputs = [inputs]
    for weight, bias in zip(weights, biases, strict=True):
        # Without those before, each takes the memory of the one before the last, which is still near.
        if inputs.is_cuda:
            following = torch.relu_(torch.addmm(bias, outputs[-1], weight.mT))
        else:
            following = torch.ops.mkldnn._linear_pointwise(outputs[-1], weight, bias, "leaky_relu", [SLOPE], "")
        outputs = [*(outputs if is_kept else []), following]
    return outputs[1:] if is_kept else outputs


_relu_layers = op(
    "relu_layers(Tensor inputs, Tensor[] weights, Tensor[] biases, bool is_kept) -> Tensor[]", "relu_layers.relu_layers"
)


class _Layers(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, inputs: Tensor, *parameters: Tensor) -> Tensor:
        num_layers = len(parameters) // 2
        outputs = [inputs, *_run(inputs, parameters[:num_layers], parameters[num_layers:], is_kept=True)]
        ctx.save_for_backward(*outputs, *parameters[:num_layers])
        return outputs[-1]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        num_layers = len(ctx.saved_tensors) // 2
        outputs, weights = ctx.saved_tensors[: num_layers + 1], ctx.saved_tensors[num_layers + 1 :]
        grad = grads[0]
        of_weights, of_biases = [grad] * num_layers, [grad] * num_layers
        for i in reversed(range(num_layers)):
            grad = torch.ops.aten.threshold_backward(grad, outputs[i + 1], 0)
            of_weights[i] = _outer_sum(grad, outputs[i])
            # On GPUs a product with ones takes a fraction of what a sum over rows does.
            of_biases[i] = grad.new_ones(1, len(grad)).mm(grad)[0] if grad.is_cuda else grad.sum(0)
            if i or ctx.needs_input_grad[0]:
                grad = grad @ weights[i]
        return grad if ctx.needs_input_grad[0] else None, *of_weights, *of_biases


def _outer_sum(left: Tensor, right: Tensor) -> Tensor:
    """The sum over rows of their outer products: (N, A), (N, B) -> (A, B)."""
    if left.is_cuda or len(left) % PARTS:
        return left.mT @ right
    products = left.unflatten(0, (PARTS, -1)).mT @ right.unflatten(0, (PARTS, -1))
    return products.float().sum(0).to(left.dtype)
