"""Train, score, film and follow points on a pretended device, and say how it went, as JSON.

    python tests/on_other_device.py

Started by the tests in a process of its own: torch has to know of the device before its first gradient.
"""

import json
import runpy
import sys
import tempfile
import traceback
from pathlib import Path

import torch
from other_device import Elsewhere, other_device

SCRIPTS = Path(__file__).parents[1] / "scripts"
TINY = [
    "data=synthetic", "scene=glossy_ball", "data.resolution=24", "data.num_train=12", "data.num_val=2",
    "data.num_test=1", "seed=0", "evaluate_frames=1", "trainer/pixels=error_guided", "+trainer/callbacks=previews",
    "trainer.callbacks.previews.every=8", "trainer.num_steps=12", "trainer.num_rays=256",
    "trainer.target_samples=1024", "trainer.log_every=4", "trainer.callbacks.checkpoints.every=8",
    "~trainer.callbacks.progress_bar", "renderer.precision=float32", "field.resolutions=[8,16,24]",
    "sampler.grid.resolution=24", "+sampler.grid.num_probes=2048",
]  # fmt: skip


def run(script: str, *arguments: str) -> int:
    """The exit code of a script, run here."""
    sys.argv = [str(SCRIPTS / script), *arguments]
    torch.set_grad_enabled(True)  # some scripts end without
    try:
        runpy.run_path(sys.argv[0], run_name="__main__")
    except SystemExit as end:
        return int(end.code or 0)
    except Exception:  # noqa: BLE001 - whatever it is, the test says so
        traceback.print_exc()
        return 1
    return 0


def walk(experiment: str, folder: str) -> dict[str, int]:
    """Exit codes of all scripts in turn."""
    settings = [f"experiment={experiment}", *TINY, f"out_dir={folder}"]
    if experiment == "fast":
        return {"train": run("train.py", *settings, "renderer.field.deformation.resolution=16")}
    film = ["render.py", f"run={folder}", "format=npz", "resolution=16"]
    temporal = ["temporal.enabled=true", "temporal.num_frames=3", "temporal.resolution=16"]
    commands = {
        "train": ["train.py", *settings],
        "resume": ["train.py", *settings, "trainer.num_steps=16", "resume=true"],
        "evaluate": ["evaluate.py", f"run={folder}", "split=val", "max_frames=1", "plots=false", *temporal],
        "render": [*film, "path=orbit", "num_frames=16", "outputs=[rgb,depth]"],
        "motion": [*film, "path=fixed", "time=sweep", "num_frames=2", "outputs=[motion,deformation]"],
    }
    return {name: run(*command) for name, command in commands.items()}


def main() -> None:
    sys.path.insert(0, str(SCRIPTS))
    import hydra_app

    codes: dict[str, dict[str, int]] = {}
    with other_device() as device, tempfile.TemporaryDirectory() as folder:
        hydra_app.resolve_device = lambda name: device
        output, sys.stdout = sys.stdout, sys.stderr
        for experiment in ("fast", "flow_gpu"):
            codes[experiment] = walk(experiment, str(Path(folder) / experiment))
        sys.stdout = output
        mixed = False
        try:
            torch.zeros(2, device=device) + torch.zeros(2)
        except RuntimeError:
            mixed = isinstance(torch.zeros(2, device=device), Elsewhere)
    sys.stdout.write(json.dumps({"codes": codes, "is_mixing_refused": mixed}))


if __name__ == "__main__":
    main()
