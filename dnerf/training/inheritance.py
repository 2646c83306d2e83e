"""Going on with another model: weights, the optimiser's moments and the state of a run are taken over by name."""

import torch
from torch import Tensor, nn

from dnerf.nn.parameter_groups import labels_of
from dnerf.training.run import Run

NUMBERS = ("step", "seconds", "progress", "num_rays", "rays_done", "rate_factor", "last_record")


@torch.no_grad()
def take_over(run: Run, begun: Run) -> None:
    """Let a run that was just begun go on where another one stands, which is left as it is.

    Parameters, buffers and moments are those of the same name. Where sizes differ, rows are matched by their labels
    (`HasOutputLabels`), or else the common leading part is taken over; what is new keeps its initial value, and has no
    moments yet. The pixel sampler's state is taken over if it fits.
    """
    if run.renderer is not begun.renderer:
        _copy(begun.renderer.state_dict(), run.renderer.state_dict(), begun.renderer, run.renderer)
    own, other = dict(run.renderer.named_parameters()), dict(begun.renderer.named_parameters())
    for name in filter(other.__contains__, own):
        state = begun.optimizer.state.get(other[name])
        if not state:
            continue
        moments = {key: torch.zeros_like(own[name]) for key in state if key != "step"}
        for key, value in moments.items():
            _copy({name: state[key]}, {name: value}, begun.renderer, run.renderer)
        run.optimizer.state[own[name]] = {"step": state["step"].clone(), **moments}
    run.generator.set_state(begun.generator.get_state())
    for key in NUMBERS:
        setattr(run, key, getattr(begun, key))
    mine, state = run.pixels.state_dict(), begun.pixels.state_dict()
    if mine.keys() == state.keys() and all(mine[key].shape == state[key].shape for key in mine):
        run.pixels.load_state_dict({key: value.clone() for key, value in state.items()})
    run.renderer.invalidate()


def _copy(source: dict[str, Tensor], target: dict[str, Tensor], before: nn.Module, after: nn.Module) -> None:
    """Copy tensors of the same name, in place, as far as they have places in common."""
    old_labels, new_labels = labels_of(before), labels_of(after)
    for name in filter(target.__contains__, source):
        old, new = source[name], target[name]
        if old.shape == new.shape and old_labels.get(name) == new_labels.get(name):
            new.copy_(old)
        elif old.ndim != new.ndim:
            continue
        elif name in old_labels and name in new_labels:
            rows = {label: row for row, label in enumerate(old_labels[name])}
            for row, label in enumerate(new_labels[name]):
                if label in rows:
                    _copy_common(old[rows[label]], new[row])
        else:
            _copy_common(old, new)


def _copy_common(old: Tensor, new: Tensor) -> None:
    """Copy the leading part that two tensors of as many axes have in common."""
    common = tuple(slice(min(a, b)) for a, b in zip(old.shape, new.shape, strict=True))
    new[common] = old[common]
