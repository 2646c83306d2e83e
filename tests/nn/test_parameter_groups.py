"""Learning-rate groups are what modules declare, each parameter in one."""

import torch
from torch import nn

from dnerf.nn.mlp import MLP
from dnerf.nn.parameter_groups import DEFAULT, DeclaresGroups, ParameterGroup, collect_groups, network_groups


class Part(nn.Module, DeclaresGroups):
    """A network and a table of a module of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.network = MLP(4, 32, 2, out_features=3)
        self.table = nn.Parameter(torch.zeros(5, 2))

    def parameter_groups(self) -> list[ParameterGroup]:
        groups = network_groups(self.network, "network", self.network.output)
        return [*groups, ParameterGroup("table", (self.table,))]


class Whole(nn.Module, DeclaresGroups):
    """Takes its part's table for a group of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.part = Part()
        self.other = nn.Linear(2, 2)

    def parameter_groups(self) -> list[ParameterGroup]:
        return [ParameterGroup("mine", (self.part.table,))]


def test_each_parameter_is_in_one_group_and_the_outermost_module_decides() -> None:
    whole = Whole()
    groups = {(group.name, group.orthogonal): group.parameters for group in collect_groups(whole)}
    first, second = whole.part.network.hidden
    # The first layer has fewer columns than pay for orthogonalised steps.
    expected = {
        (DEFAULT, False): (whole.other.weight, whole.other.bias), ("mine", False): (whole.part.table,),
        ("network", True): (second.weight,), ("network", False): (first.weight, first.bias, second.bias),
        ("network_output", False): (whole.part.network.output.weight, whole.part.network.output.bias),
    }  # fmt: skip
    assert {key: {id(p) for p in group} for key, group in groups.items() if group} == {
        key: {id(p) for p in group} for key, group in expected.items()
    }
    assert sum(map(len, groups.values())) == len(list(whole.parameters()))
