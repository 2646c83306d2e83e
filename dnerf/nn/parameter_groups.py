"""What modules declare of their parameters and buffers: learning-rate groups, meanings of rows, what training needs."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import cast

from torch import nn

DEFAULT = "default"
LEAST_ROWS = 16  # rows and columns of a matrix from which orthogonalised steps pay


@dataclass(frozen=True)
class ParameterGroup:
    """Parameters that learn at one rate."""

    name: str  # settings give rates by it
    parameters: tuple[nn.Parameter, ...]
    orthogonal: bool = False  # whether these are matrices that may take orthogonalised steps, see `AdamMuon`


class DeclaresGroups(ABC):
    """A module that says which groups its parameters belong to; what it leaves out is for its parts, or "default"."""

    @abstractmethod
    def parameter_groups(self) -> list[ParameterGroup]:
        """Groups of some of its own or its children's parameters."""


def collect_groups(model: nn.Module) -> list[ParameterGroup]:
    """Groups of all parameters of a model, each parameter in one: the outermost module that declares it decides.

    Returns:
        One group for each name and kind of step, in order of their names; undeclared parameters are in "default".
    """
    taken: set[int] = set()
    members: dict[tuple[str, bool], list[nn.Parameter]] = {}
    declared = [g for m in model.modules() if isinstance(m, DeclaresGroups) for g in m.parameter_groups()]
    for group in [*declared, ParameterGroup(DEFAULT, tuple(model.parameters()))]:
        for parameter in group.parameters:
            if id(parameter) not in taken:
                taken.add(id(parameter))
                members.setdefault((group.name, group.orthogonal), []).append(parameter)
    return [ParameterGroup(name, tuple(members[name, kind]), kind) for name, kind in sorted(members)]


def network_groups(network: nn.Module, name: str, output: nn.Module | None = None) -> list[ParameterGroup]:
    """Groups of a network: matrices that may take orthogonalised steps, and the rest; apart, as "<name>_output", those
    of its last layer, if one is given."""
    last = [] if output is None else list(output.parameters())
    apart = {id(parameter) for parameter in last}
    weights = [cast(nn.Parameter, m.weight) for m in network.modules() if isinstance(m, nn.Linear)]
    linear = [weight for weight in weights if id(weight) not in apart]
    matrices = [weight for weight in linear if min(weight.shape) >= LEAST_ROWS]
    apart |= {id(parameter) for parameter in matrices}
    rest = [parameter for parameter in network.parameters() if id(parameter) not in apart]
    return [
        ParameterGroup(name, tuple(matrices), orthogonal=True),
        ParameterGroup(name, tuple(rest)),
        ParameterGroup(f"{name}_output", tuple(last)),
    ]


class HasOutputLabels(ABC):
    """A module some of whose parameters have rows that mean something by themselves: other models may take them."""

    @abstractmethod
    def output_labels(self) -> Mapping[str, Sequence[str]]:
        """Labels of the rows of its own or its children's parameters, by the parameter's name."""


def labels_of(model: nn.Module) -> dict[str, Sequence[str]]:
    """Labels of rows by the parameter's name in the whole model."""
    return {
        f"{prefix}.{name}" if prefix else name: labels
        for prefix, module in model.named_modules()
        if isinstance(module, HasOutputLabels)
        for name, labels in module.output_labels().items()
    }


class HasTrainingBuffers(ABC):
    """A module with buffers that evaluation mode never reads: checkpoints hold them, files of weights do not."""

    @abstractmethod
    def training_buffers(self) -> tuple[str, ...]:
        """Names of those of its own persistent buffers."""


def training_buffer_names(model: nn.Module) -> set[str]:
    """Names, as in the model's `state_dict`, of all buffers that only training needs."""
    return {
        f"{prefix}.{name}" if prefix else name
        for prefix, module in model.named_modules()
        if isinstance(module, HasTrainingBuffers)
        for name in module.training_buffers()
    }
