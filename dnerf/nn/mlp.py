"""The multi-layer perceptron that fields and deformations share."""

from collections.abc import Callable, Sequence
from typing import cast

import torch
from torch import Tensor, nn

from dnerf.core.checks import check_choice, check_positive
from dnerf.kernels import relu_layers

ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "relu": torch.relu_, "silu": nn.functional.silu, "softplus": nn.functional.softplus,
}  # fmt: skip


class MLP(nn.Module):
    """Linear layers with an activation between them; the input may be fed in again at hidden layers ("skips").

    Args:
        in_features: size of the input.
        hidden_features: width of every hidden layer.
        num_layers: number of hidden layers, >= 0; with 0 the network is one linear map.
        out_features: size of the output; None ends after the last hidden layer, activation included.
        skips: hidden layers, counted from 0, whose input is the previous activation and the network's input
            (NeRF and D-NeRF: (5,) of eight).
        zero_output: start the last linear map at zero, so that the network is zero at initialisation.
        activation: "relu", or "silu" or "softplus" for a smooth network.

    Raises:
        ValueError: if sizes are not positive, a skip names no hidden layer but the first, or the activation is unknown.
    """

    def __init__(
        self, in_features: int, hidden_features: int, num_layers: int, *, out_features: int | None = None,
        skips: Sequence[int] = (), zero_output: bool = False, activation: str = "relu",
    ) -> None:  # fmt: skip
        super().__init__()
        check_choice("activation", activation, tuple(ACTIVATIONS))
        self.activation = ACTIVATIONS[activation]
        check_positive("in_features", in_features)
        check_positive("hidden_features", hidden_features)
        check_positive("num_layers", num_layers, allow_zero=True)
        if any(not 0 < skip < num_layers for skip in skips):
            raise ValueError(f"skips must lie in 1..{num_layers - 1}, got {tuple(skips)}")
        self.in_features = in_features
        self.skips = frozenset(skips)
        widths = [
            (in_features if i == 0 else hidden_features) + (in_features if i in self.skips else 0)
            for i in range(num_layers)
        ]
        hidden = [nn.Linear(width, hidden_features) for width in widths]
        self.hidden = nn.ModuleList(hidden)
        last = hidden_features if num_layers else in_features
        self.output = None if out_features is None else nn.Linear(last, out_features)
        self.out_features = last if out_features is None else out_features
        for layer in hidden:
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)
        if zero_output and self.output is not None:
            nn.init.zeros_(self.output.weight)
            nn.init.zeros_(self.output.bias)

    def forward(self, inputs: Tensor, scale: Tensor | None = None) -> Tensor:
        """Map (..., in_features) -> (..., out_features).

        Args:
            inputs: (..., in_features).
            scale: factor on each of them; None for 1. ReLU networks without skips scale their first weights instead.

        Raises:
            ValueError: for another number of inputs.
        """
        x = self.before_output(inputs, scale)
        return x if self.output is None else self.output(x)

    def before_output(self, inputs: Tensor, scale: Tensor | None = None) -> Tensor:
        """Map inputs to what the last linear map sees, see `forward`."""
        if inputs.shape[-1] != self.in_features:
            raise ValueError(f"inputs must have {self.in_features} columns, got {inputs.shape[-1]}")
        layers = self.relu_parameters(scale)
        if layers is not None:
            return relu_layers(inputs, *layers)
        if scale is not None:
            inputs = inputs * scale.to(inputs.dtype)
        x = inputs
        for i, layer in enumerate(self.hidden):
            x = self.activation(layer(torch.cat([x, inputs], dim=-1) if i in self.skips else x))
        return x

    def relu_parameters(self, scale: Tensor | None = None) -> tuple[list[Tensor], list[Tensor]] | None:
        """Weights and biases of all hidden layers, for inputs as `forward` takes them; None unless these are ReLU
        layers, one after the other."""
        if not self.hidden or self.skips or self.activation is not torch.relu_:
            return None
        layers = [cast(nn.Linear, layer) for layer in self.hidden]
        first, *others = (layer.weight for layer in layers)
        first = first if scale is None else first * scale.to(first.dtype)
        return [first, *others], [layer.bias for layer in layers]
