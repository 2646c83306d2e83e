"""One HTML page about a run, to be sent around: python scripts/report.py run=runs/mutant"""

import json
from pathlib import Path
from typing import Any

from hydra_app import load_config, run_app
from omegaconf import DictConfig

from dnerf.core.files import write_text
from dnerf.evaluation.report import read_scores, write_report_text
from dnerf.planning.plan import FILE as PLAN
from dnerf.planning.plan import load_plan
from dnerf.visualization import OUTPUTS

SHEETS = (
    ("contact_sheet", "Contact sheet", "Frames spread evenly over the split: prediction, truth, absolute error."),
    ("worst_frames", "Worst frames", "Lowest PSNR first: prediction, truth, absolute error."),
)
OTHER_OUTPUTS = tuple(f"_{output}" for output in OUTPUTS if output != "rgb")
"""Ends of the names of films that show something else than colour: they come after those that do."""


def main(config: DictConfig) -> None:
    """Collect what evaluation and rendering left in the run's folder; write the page."""
    load_config(config.run)
    folder = Path(config.run)
    metrics = read_scores(folder)
    found = sorted((folder / "renders").glob("*.mp4"), key=lambda film: (film.stem.endswith(OTHER_OUTPUTS), film.name))
    films = found if config.films is None else [Path(film) for film in config.films]
    for film in films:
        if not film.is_file():
            raise ValueError(f"films: {film} does not exist")
    splits = list(dict.fromkeys(m["split"] for m in metrics))
    sheets = [
        (f"{heading}, {split} split", caption, path)
        for split in splits
        for stem, heading, caption in SHEETS
        if (path := folder / f"{stem}_{split}.png").is_file()
    ]
    text = write_report_text(
        title=config.title or f"{metrics[0].get('scene', folder.resolve().name)}: a dynamic radiance field",
        metrics=metrics, config=(folder / "config.yaml").read_text(encoding="utf-8"), films=films, sheets=sheets,
        temporal=_temporal(folder / "temporal.json"),
        plan=load_plan(folder / PLAN).rows() if (folder / PLAN).is_file() else [],
    )  # fmt: skip
    output = Path(config.output or folder / "report.html")
    write_text(output, text)
    print(f"{len(films)} films, {len(sheets)} sheets, {len(text) / 2**20:.1f} MiB: {output}")
    if not films:
        print(f"no film: python scripts/render.py run={config.run} makes one")


def _temporal(path: Path) -> dict[str, Any] | None:
    if not path.is_file():
        return None
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: not a readable JSON file ({error})") from error
    if not isinstance(values, dict) or not {"motion", "num_frames"} <= values.keys():
        raise ValueError(f"{path}: expected the scores of evaluate.py temporal.enabled=true")
    return values


if __name__ == "__main__":
    run_app(main, "report")
