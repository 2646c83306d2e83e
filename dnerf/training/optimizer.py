"""Adam, with orthogonalised momentum for the matrices of networks that ask for it, and schedules of its rates."""

import logging
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from dnerf.core.checks import check_mapping, check_positive, check_whole
from dnerf.core.schedules import Ramp
from dnerf.kernels import has_bfloat16
from dnerf.nn.parameter_groups import DEFAULT, collect_groups

logger = logging.getLogger(__name__)

# A quintic whose iteration takes every singular value in (0, 1] to 0.7 ... 1.2 within five rounds (Jordan 2024).
QUINTIC = (3.4445, -4.7750, 2.0315)
ROUNDS = 5
MOMENTUM = 0.95  # of orthogonalised steps, as of Muon
RMS_OF_ADAM = 0.2  # root mean square of Adam's updates, in learning rates (Liu et al. 2025, section 2.2)


def orthogonalized(matrices: Tensor) -> Tensor:
    """The nearest semi-orthogonal matrices of a batch (K, M, N), roughly: singular values become 0.7 to 1.2.

    Source: Newton-Schulz iteration of Muon (Jordan et al. 2024, https://kellerjordan.github.io/posts/muon). A matrix
    of zeros stays one.
    """
    if matrices.shape[-2] > matrices.shape[-1]:
        return orthogonalized(matrices.mT).mT
    a, b, c = QUINTIC
    tiny = torch.finfo(matrices.dtype).tiny
    x = matrices / matrices.abs().amax((-2, -1), keepdim=True).clamp(min=tiny)  # squares of small entries underflow
    x = x / torch.linalg.matrix_norm(x, keepdim=True).clamp(min=tiny)
    x = x.bfloat16() if has_bfloat16(x.device.type) else x
    for _ in range(ROUNDS):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.to(matrices.dtype)


class AdamMuon(torch.optim.Adam):
    """Adam; groups with `orthogonal=True` take Muon's step: momentum, orthogonalised.

    An orthogonalised step moves all directions of a weight matrix alike, also those that rarely matter to the loss of
    one batch. It finds deformations in fewer steps; tables, biases and last layers are better off with Adam.

    Sources: Kingma and Ba 2015; Jordan et al. 2024 (Muon, with Nesterov momentum); Liu et al. 2025 (arXiv 2502.16982)
    for the size 0.2 sqrt(max(M, N)), which lets both share learning rates.

    Args:
        groups: parameter groups as of Adam, with "orthogonal", a bool, for those made of (M, N) matrices.
        settings: as of Adam.

    Raises:
        ValueError: for an orthogonal parameter that is no matrix.
    """

    def __init__(self, groups: Iterable[dict[str, Any]], **settings: Any) -> None:
        listed = [{"orthogonal": False, **group} for group in groups]
        for group in listed:
            for parameter in group["params"]:
                if group["orthogonal"] and parameter.ndim != 2:
                    raise ValueError(f"orthogonal parameters must be matrices, got shape {tuple(parameter.shape)}")
        super().__init__(listed, **settings)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """One step on all parameters that have a gradient, as of Adam."""
        loss = None if closure is None else torch.enable_grad()(closure)()
        held: list[tuple[nn.Parameter, Tensor]] = []
        for group in self.param_groups:
            if group["orthogonal"]:
                members = [(p, p.grad) for p in group["params"] if p.grad is not None]
                self._orthogonal_step(members, group["lr"])
                held += members
        for parameter, _ in held:  # Adam passes by what has no gradient.
            parameter.grad = None
        super().step()
        for parameter, gradient in held:
            parameter.grad = gradient
        return loss

    def make_capturable(self) -> None:
        """Keep rates, as tensors, and counts on the parameters' device: steps can then be part of a CUDA graph."""
        for group in self.param_groups:
            group["capturable"] = True
            if not isinstance(group["lr"], Tensor):
                group["lr"] = torch.tensor(float(group["lr"]), device=group["params"][0].device)

    def set_rates(self, factor: float) -> None:
        """Set every group's learning rate to its initial one times a factor."""
        for group in self.param_groups:
            rate = group["initial_lr"] * factor
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate

    def _orthogonal_step(self, members: list[tuple[nn.Parameter, Tensor]], rate: float | Tensor) -> None:
        by_shape: dict[torch.Size, list[tuple[nn.Parameter, Tensor]]] = defaultdict(list)
        for parameter, gradient in members:
            state = self.state[parameter]
            if not state:
                state["step"], state["exp_avg"] = torch.zeros((), device=parameter.device), torch.zeros_like(parameter)
            state["step"] += 1
            average = state["exp_avg"].lerp_(gradient, 1 - MOMENTUM)
            by_shape[parameter.shape].append((parameter, torch.lerp(gradient, average, MOMENTUM)))
        for shape, alike in by_shape.items():
            steps = orthogonalized(torch.stack([direction for _, direction in alike]))
            steps = steps * (rate * (RMS_OF_ADAM * max(shape) ** 0.5))
            torch._foreach_sub_([parameter for parameter, _ in alike], list(steps.unbind()))


def moments_of(optimizer: torch.optim.Optimizer, parameter: nn.Parameter) -> frozenset[str]:
    """Names of the tensors that the optimiser keeps for a parameter, once it has had a gradient."""
    for group in optimizer.param_groups:
        if any(member is parameter for member in group["params"]):
            return frozenset({"step", "exp_avg"} | (set() if group.get("orthogonal") else {"exp_avg_sq"}))
    raise ValueError("the parameter must be one of the optimiser's")


class AdamSettings:
    """How a model's parameters are optimised: rates by the groups that its modules declare, and how they fall.

    Learning rates are a group's own, times min(1, (step + 1) / (warmup_steps + 1)), times
    final_rate^((p - hold_until) / (1 - hold_until)) from progress p = `hold_until` on.

    Args:
        learning_rates: by group, see `dnerf.nn.parameter_groups`; "default" is for all that no name is given for.
        weight_decays: by group, 0 where none is given: so many times itself joins a parameter's gradient. Adam divides
            by the gradients' size: with a small number what images say nothing of falls to zero, and little else moves.
            Matrices that take orthogonalised steps have no decay.
        final_rate: factor on all rates at the end of training, > 0.
        hold_until: progress in [0, 1) until which rates are held.
        warmup_steps: steps over which they rise linearly from near zero.
        betas: Adam's moment decay rates.
        epsilon: Adam's epsilon.
        orthogonal: whether the matrices that modules declare so take orthogonalised steps, see `AdamMuon`.

    Raises:
        ValueError: for numbers out of range, or rates without a default.
    """

    def __init__(
        self, learning_rates: Mapping[str, float] | None = None, *, weight_decays: Mapping[str, float] | None = None,
        final_rate: float = 0.1, hold_until: float = 0.0, warmup_steps: int = 0, betas: Sequence[float] = (0.9, 0.999),
        epsilon: float = 1e-8, orthogonal: bool = False,
    ) -> None:  # fmt: skip
        self.learning_rates = {DEFAULT: 5e-4} if learning_rates is None else learning_rates
        check_mapping("learning_rates", self.learning_rates, allow_zero=True)
        self.weight_decays = {} if weight_decays is None else weight_decays
        check_mapping("weight_decays", self.weight_decays, allow_zero=True)
        if DEFAULT not in self.learning_rates:
            raise ValueError(f"learning_rates must have a rate for {DEFAULT!r}, got {self.learning_rates}")
        check_positive("final_rate", final_rate)
        check_whole("warmup_steps", warmup_steps, allow_zero=True)
        check_positive("epsilon", epsilon, allow_zero=True)
        if not 0 <= hold_until < 1:
            raise ValueError(f"hold_until must be in [0, 1), got {hold_until}")
        if len(betas) != 2 or not all(0 <= beta < 1 for beta in betas):
            raise ValueError(f"betas must be two numbers in [0, 1), got {betas!r}")
        self.decay = Ramp(1.0, final_rate, hold_until, 1.0, kind="exponential")
        self.warmup_steps, self.epsilon, self.orthogonal = warmup_steps, epsilon, orthogonal
        self.betas = (betas[0], betas[1])

    def build(self, model: nn.Module) -> AdamMuon:
        """A fresh optimiser of a model's parameters; groups note their rates as "initial_lr"."""
        groups = collect_groups(model)
        for name in self.learning_rates.keys() - {group.name for group in groups} - {DEFAULT}:
            logger.warning("learning_rates: no part of the model declares the group %r", name)
        listed = []
        for group in groups:
            rate = self.learning_rates.get(group.name, self.learning_rates[DEFAULT])
            rates = {"lr": rate, "initial_lr": rate, "weight_decay": self.weight_decays.get(group.name, 0.0)}
            listed.append({"params": group.parameters, **rates, "orthogonal": group.orthogonal and self.orthogonal})
        return AdamMuon(listed, betas=self.betas, eps=self.epsilon, fused=True)

    def factor(self, step: int, progress: float) -> float:
        """What learning rates are multiplied by after so many steps, at a progress in [0, 1]."""
        return min(1.0, (step + 1) / (self.warmup_steps + 1)) * self.decay(progress)
