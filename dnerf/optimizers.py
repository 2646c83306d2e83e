"""Adam, with orthogonalised momentum for the matrices of networks that ask for it, and schedules of its rates."""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

import torch
from torch import Tensor, nn

# A quintic whose iteration takes every singular value in (0, 1] to 0.7 ... 1.2 within five rounds (Jordan 2024).
QUINTIC = (3.4445, -4.7750, 2.0315)
ROUNDS = 5
SCHEDULES = ("exponential", "cosine", "constant")
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
    x = (x / torch.linalg.matrix_norm(x, keepdim=True).clamp(min=tiny)).bfloat16()
    for _ in range(ROUNDS):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.to(matrices.dtype)


class AdamMuon(torch.optim.Adam):
    """Adam; groups with `orthogonal=True` take Muon's step: momentum, orthogonalised, at the size of Adam's steps.

    An orthogonalised step moves all directions of a weight matrix alike, also those that rarely matter to the loss
    of one batch. It finds deformations in fewer steps than Adam; tables, biases and last layers are better off with
    Adam.

    Sources: Kingma and Ba 2015; Jordan et al. 2024 (Muon, with Nesterov momentum); Liu et al. 2025 (arXiv 2502.16982)
    for the size 0.2 sqrt(max(M, N)), which lets both share learning rates.

    Args:
        groups: parameter groups as of Adam, with "orthogonal", a bool, for those made of (M, N) matrices.
        lr: learning rate of groups without one.
        betas: Adam's moment decay rates.
        eps: Adam's epsilon.
        momentum: of orthogonal groups, in [0, 1).
        fused: as of Adam.

    Raises:
        ValueError: for an orthogonal parameter that is no matrix, or a momentum outside [0, 1).
    """

    def __init__(
        self,
        groups: Iterable[dict[str, Any]],
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        *,
        momentum: float = 0.95,
        fused: bool | None = None,
    ) -> None:
        if not 0 <= momentum < 1:
            raise ValueError(f"momentum must be in [0, 1), got {momentum}")
        listed = [{"orthogonal": False, "momentum": momentum, **group} for group in groups]
        for group in listed:
            for parameter in group["params"]:
                if group["orthogonal"] and parameter.ndim != 2:
                    raise ValueError(f"orthogonal parameters must be matrices, got shape {tuple(parameter.shape)}")
        super().__init__(listed, lr=lr, betas=betas, eps=eps, fused=fused)

    @classmethod
    def of(
        cls,
        model: nn.Module,
        rates: Mapping[str, float],
        *,
        orthogonal: Sequence[str] = (),
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
    ) -> "AdamMuon":
        """An optimiser of a model's parameters, which also notes the groups' rates as "initial_lr".

        Args:
            model: whose parameters are optimised.
            rates: learning rates by parameter-name prefix, in which * stands for anything; "" is the default, the
                longest match wins.
            orthogonal: prefixes below which the weights of linear maps of 16 rows and columns or more are orthogonal.
            betas: Adam's moment decay rates.
            eps: Adam's epsilon.
        """
        matrices = {
            f"{name}.weight"
            for name, module in model.named_modules()
            if isinstance(module, nn.Linear) and name.startswith(tuple(orthogonal)) and min(module.weight.shape) >= 16
        }
        groups: dict[tuple[str, bool], list[nn.Parameter]] = defaultdict(list)
        for name, parameter in model.named_parameters():
            prefix = max((p for p in rates if fnmatchcase(name, p + "*")), key=len)
            groups[prefix, name in matrices].append(parameter)
        listed = [
            {"params": groups[key], "lr": rates[key[0]], "initial_lr": rates[key[0]], "orthogonal": key[1]}
            for key in sorted(groups)
        ]
        return cls(listed, betas=betas, eps=eps, fused=True)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """One step on all parameters that have a gradient, as of Adam."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        held: list[tuple[nn.Parameter, Tensor]] = []
        for group in self.param_groups:
            if group["orthogonal"]:
                members = [(p, p.grad) for p in group["params"] if p.grad is not None]
                self._orthogonal_step(members, group["lr"], group["momentum"])
                held += members
        for parameter, _ in held:  # Adam passes by what has no gradient.
            parameter.grad = None
        super().step()
        for parameter, gradient in held:
            parameter.grad = gradient
        return loss

    def make_capturable(self) -> None:
        """Keep learning rates and counts on the parameters' device, so that steps can be part of a CUDA graph.

        A rate then is a scalar tensor, which `set_rates` fills.
        """
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

    def _orthogonal_step(
        self, members: list[tuple[nn.Parameter, Tensor]], rate: float | Tensor, momentum: float
    ) -> None:
        by_shape: dict[torch.Size, list[tuple[nn.Parameter, Tensor]]] = defaultdict(list)
        for parameter, gradient in members:
            state = self.state[parameter]
            if not state:
                state["step"], state["exp_avg"] = torch.zeros((), device=parameter.device), torch.zeros_like(parameter)
            state["step"] += 1
            average = state["exp_avg"].lerp_(gradient, 1 - momentum)
            by_shape[parameter.shape].append((parameter, torch.lerp(gradient, average, momentum)))
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


def rate_factor(schedule: str, final: float, warmup_steps: int, progress: float, step: int) -> float:
    """What learning rates are multiplied by.

    Args:
        schedule: one of `SCHEDULES`.
        final: the factor at the end of "exponential" and "cosine".
        warmup_steps: steps over which the factor rises linearly from near zero.
        progress: of training, in [0, 1].
        step: steps done.
    """
    warmup = min(1.0, (step + 1) / (warmup_steps + 1))
    if schedule == "exponential":
        return warmup * final**progress
    if schedule == "cosine":
        return warmup * (final + (1 - final) * 0.5 * (1 + math.cos(math.pi * progress)))
    return warmup
