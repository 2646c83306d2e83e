"""What scripts load sooner or later, for processes from which they are forked: most of their time is spent on it."""

import importlib
import pkgutil
from pathlib import Path

import dnerf

CONF = Path(__file__).resolve().parents[1] / "conf"


def load_everything() -> None:
    """Load it; nothing that starts threads, which a forked child would lack."""
    from hydra import compose, initialize_config_dir

    for name in ("torch._dynamo", "torchmetrics"):
        importlib.import_module(name)
    for part in pkgutil.walk_packages(dnerf.__path__, "dnerf."):
        if not part.name.startswith("dnerf.kernels.gpu."):
            importlib.import_module(part.name)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        compose("train")
