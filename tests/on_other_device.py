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
from test_body_search import BOX, a_renderer, bodies_of, frames_of_two_balls, wrong_where_matter_is

from dnerf.body_search import BodySearch
from dnerf.training import Trainer

SCRIPTS = Path(__file__).parents[1] / "scripts"
TINY = [
    "scene=glossy_ball", "data.resolution=24", "data.num_train=12", "data.num_val=2", "data.num_test=1",
    "seed=0", "evaluate_frames=1", "preview_every=8", "renderer.precision=float32",
    "trainer.num_steps=12", "trainer.num_rays=256", "trainer.target_samples=1024", "trainer.log_every=4",
    "trainer.checkpoint_every=8", "trainer.progress_bar=false", "trainer.box_check.every=4",
    "trainer.missing_matter.share=1.0e-6", "trainer.missing_matter.every=1", "trainer.missing_matter.min_steps=4",
    "field.resolutions=[8,16,24]", "sampler.resolution=24", "sampler.num_probes=2048",
    "renderer.field.frame_lattice.resolution=16",
    "renderer.field.baking.resolution=24", "field.density_shift=-4",  # thin, so that matter is lacking
]  # fmt: skip
SHORT_SEARCH = ["motion_search.num_steps=3", "motion_search.num_rays=200"]


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
        return {"train": run("train.py", *settings)}
    settings += SHORT_SEARCH
    return {
        "train": run("train.py", *settings),
        "resume": run("train.py", *settings, "trainer.num_steps=16", "resume=true"),
        "evaluate": run(
            "evaluate.py", f"run={folder}", "split=val", "max_frames=1", "plots=false",
            "temporal.enabled=true", "temporal.num_frames=3", "temporal.resolution=16",
        ),
        "render": run(
            "render.py", f"run={folder}", "path=orbit", "num_frames=16", "format=npz", "resolution=16",
            "outputs=[rgb,depth]",
        ),
        "motion": run(
            "render.py", f"run={folder}", "path=fixed", "time=sweep", "num_frames=2", "format=npz", "resolution=16",
            "outputs=[motion,deformation]",
        ),
    }  # fmt: skip


def carry_bodies(device: torch.device) -> dict[str, int | float]:
    """A fast ball is looked for and carried; then a few steps, with free and with fixed numbers of samples."""
    frames = frames_of_two_balls()
    found = {}
    for name, place in (("there", device), ("here", torch.device("cpu"))):
        renderer, pictures = a_renderer().to(place), frames.to(place)
        BodySearch(BOX)(300, renderer, pictures, wrong_where_matter_is(pictures))
        found[name] = renderer
    there, here = (bodies_of(renderer) for renderer in found.values())
    losses = [
        Trainer(num_steps=4, num_rays=64, target_samples=1000, graphs=graphs, progress_bar=False)
        .fit(found["there"], frames)
        .losses["rgb"]
        for graphs in (False, True)
    ]
    return {
        "there": there.num_bodies,
        "here": here.num_bodies,
        "apart": float((there.homes.cpu() - here.homes).abs().max()),
        "loss": max(losses),
    }


def main() -> None:
    sys.path.insert(0, str(SCRIPTS))
    import hydra_app

    codes: dict[str, dict[str, int]] = {}
    with other_device() as device, tempfile.TemporaryDirectory() as folder:
        hydra_app.resolve_device = lambda name: device
        output, sys.stdout = sys.stdout, sys.stderr
        for experiment in ("fast", "flow_gpu"):
            codes[experiment] = walk(experiment, str(Path(folder) / experiment))
        bodies = carry_bodies(device)
        sys.stdout = output
        mixed = False
        try:
            torch.zeros(2, device=device) + torch.zeros(2)
        except RuntimeError:
            mixed = isinstance(torch.zeros(2, device=device), Elsewhere)
    sys.stdout.write(json.dumps({"codes": codes, "bodies": bodies, "is_mixing_refused": mixed}))


if __name__ == "__main__":
    main()
