"""Score a run on held-out frames: python scripts/evaluate.py run=runs/mutant split=test"""

from pathlib import Path

from hydra_app import build, load_config, load_renderer, resolve_device, run_app
from omegaconf import DictConfig
from reporting import evaluate_run, print_scores


def main(config: DictConfig) -> None:
    """Load the run, render the split, write metrics.json and print a table."""
    saved = load_config(config.run)
    if config.data_root is not None:
        saved.data.root = config.data_root
    renderer = load_renderer(config.run, saved, resolve_device(config.device))
    folder = Path(config.run)
    print_scores(
        evaluate_run(
            folder,
            renderer,
            build(saved.data),
            config.split,
            max_frames=config.max_frames,
            chunk=config.chunk or saved.chunk,
        ),
        folder,
    )


if __name__ == "__main__":
    run_app(main, "evaluate")
