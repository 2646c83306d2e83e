"""What training and evaluation both report: metrics.json, a contact sheet, a table."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import Tensor

from dnerf.core.backgrounds import COLORS, ConstantBackground, parse_color
from dnerf.core.files import write_json
from dnerf.data import DataSource, Frames
from dnerf.data.background_check import SAME_LEVELS
from dnerf.data.formats.json_files import read_object
from dnerf.evaluation import FrameScore, evaluate, scores_by_time, spread_indices
from dnerf.evaluation.provenance import provenance
from dnerf.evaluation.scores import FrameCallback
from dnerf.rendering.renderer import Renderer
from dnerf.visualization import comparison_sheet, write_png

MAX_ROWS = 4


def evaluate_run(
    folder: Path, renderer: Renderer, data: DataSource, split: str, *, max_frames: int | None = None,
    chunk: int = 16384, settings: Mapping[str, object] | None = None, name: str = "metrics.json",
    lpips: Callable[[Tensor, Tensor], float] | None = None, on_frame: FrameCallback | None = None,
) -> dict[str, object]:  # fmt: skip
    """Score a run on a split, or on so many of its frames; write the scores and a contact sheet into its folder.

    Args:
        folder: of the run.
        renderer: its model.
        data: its scene.
        split: what is scored.
        max_frames: score at most so many frames.
        chunk: rays at a time.
        settings: more facts for the scores' file (scene, protocol, method).
        name: of the scores' file.
        lpips, on_frame: see `dnerf.evaluation.evaluate`.

    Raises:
        ValueError: if `training.json` is missing or broken.
    """
    training = read_training(folder)
    frames = data.frames(split)
    scored = spread_indices(len(frames), max_frames)
    chosen = {scored[k] for k in spread_indices(len(scored), MAX_ROWS)}
    pairs: list[tuple[Tensor, Tensor]] = []
    labels: list[str] = []

    def keep(score: FrameScore, prediction: Tensor, truth: Tensor) -> None:
        if on_frame is not None:
            on_frame(score, prediction, truth)
        if score.index in chosen:
            pairs.append((prediction, truth))
            labels.append(f"t = {score.time:.2f}, {score.psnr:.1f} dB")

    with on_background_of(frames, renderer):
        evaluation = evaluate(renderer, frames, split, chunk=chunk, max_frames=max_frames, on_frame=keep, lpips=lpips)
        background = _color_name(renderer)
    facts = {
        "frames_of_split": len(frames), "resolution": frames.intrinsics[0].width, "background": background
    }  # fmt: skip
    metrics = {**evaluation.as_dict(), **training, **facts, **(settings or {}), **provenance()}
    if data.train_end is not None:
        metrics |= {"train_end": data.train_end, **scores_by_time(evaluation.frames, data.train_end)}
    write_png(comparison_sheet(pairs, labels), sheet_path(folder, split))
    write_json(folder / name, metrics)
    return metrics


@contextmanager
def on_background_of(frames: Frames, renderer: Renderer) -> Iterator[None]:
    """Render before what opaque frames were taken before, where that is known and another than the model's.

    A model of images with alpha goes with any; its prediction must be compared on the images' own.
    """
    own = renderer.background
    color = None if frames.background is None else parse_color(frames.background)
    if color is not None and not frames.is_transparent and _differs(renderer, color):
        shown = [round(value, 3) for value in color]
        print(f"the images are opaque, before {shown}: predictions are put on that, not on {_color_name(renderer)}")
        renderer.background = ConstantBackground(color).to(renderer.device)
    try:
        yield
    finally:
        renderer.background = own


def _differs(renderer: Renderer, color: tuple[float, float, float]) -> bool:
    constant = renderer.background.constant()
    return constant is not None and float((constant.cpu() - torch.tensor(color)).abs().max()) > SAME_LEVELS / 255


def _color_name(renderer: Renderer) -> str:
    constant = renderer.background.constant()
    color = () if constant is None else tuple(constant.tolist())
    return next((name for name, known in COLORS.items() if known == color), str(color) if color else "learnt")


def sheet_path(folder: Path, split: str) -> Path:
    """Where a split's contact sheet lies."""
    return folder / f"contact_sheet_{split}.png"


def read_training(folder: Path) -> dict[str, object]:
    """The facts of a run's training: seconds, steps, parameters, seed.

    Raises:
        ValueError: if the file is missing or broken.
    """
    path = folder / "training.json"
    try:
        values = read_object(path)
    except ValueError as error:
        raise ValueError(f"{error}; did the training finish?") from error
    for name in ("train_seconds", "num_steps", "num_parameters"):
        if not isinstance(values.get(name), int | float):
            raise ValueError(f"{path}: {name} must be a number, got {values.get(name)!r}")
    return values


def print_scores(metrics: dict[str, object], folder: Path, name: str = "metrics.json") -> None:
    """Print a table of the frames' scores, their mean, and where the files are."""
    frames = metrics["frames"]
    assert isinstance(frames, list)
    print(f"{'frame':>6}  {'time':>5}  {'PSNR':>6}  {'SSIM':>6}")
    for frame in frames:
        print(f"{frame['index']:>6}  {frame['time']:>5.3f}  {frame['psnr']:>6.2f}  {frame['ssim']:>6.4f}")
    print(f"{'mean':>6}  {'':>5}  {metrics['psnr']:>6.2f}  {metrics['ssim']:>6.4f}")
    for part in ("interpolation", "extrapolation"):
        group = metrics.get(part)
        if isinstance(group, dict) and group["num_frames"]:
            print(f"{part}: {group['num_frames']} frames, {group['psnr']:.2f} dB, SSIM {group['ssim']:.4f}")
    print(
        f"{metrics['num_frames']} {metrics['split']} frames, {metrics['seconds_per_frame']:.3f} s a frame; "
        f"trained {metrics['train_seconds']:.0f} s, {metrics['num_steps']} steps, "
        f"{metrics['num_parameters']:,} parameters"
    )
    print(f"scores:        {folder / name}")
    print(f"contact sheet: {sheet_path(folder, str(metrics['split']))}")
