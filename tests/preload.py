"""What scripts load sooner or later, for processes from which they are forked: most of their time is spent on it."""

import importlib
import pkgutil
from pathlib import Path

CONF = Path(__file__).resolve().parents[1] / "conf"


def load_everything() -> None:
    """Load it; nothing that starts threads, which a forked child would lack."""
    import torch._dynamo
    import torchmetrics
    from hydra import compose, initialize_config_dir

    import dnerf
    import dnerf.kernels.cpu

    for package in (dnerf, dnerf.kernels.cpu):
        for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
            importlib.import_module(module.name)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        compose("train")
