"""What the outputs of a network mean, so that a model with other outputs can take over those that they share."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

from torch import nn


class HasOutputLabels(ABC):
    """A module some of whose parameters have rows that mean something by themselves."""

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
