"""Where the cameras stood, by structure from motion: COLMAP's features, matches and incremental mapping."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from PIL import Image
from tqdm import tqdm

from dnerf.capturing.frames import ChosenFrame
from dnerf.capturing.pairs import image_pairs
from dnerf.core.checks import check_choice
from dnerf.data.images import read_mask

LENSES = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE")
MATCHINGS = ("auto", "sequential", "exhaustive")
ROBUST = 0.3  # pixels, about the noise of a feature's place: larger errors weigh less and less
BATCH = 100  # pairs between two looks at the progress bar
LEAST_FEATURES = 60  # in the median frame
LEAST_INLIERS = 15  # of a pair that shows the same
LEAST_SHIFT = 0.01  # of the diagonal, between the two frames that differ most
GOOD_TRACK, GOOD_ERROR = 3, 2.0  # frames that see a point, and pixels, of points that are kept
TEXTURE = "film things with texture, in good light and in focus: a carpet, shelves, leaves rather than bare walls"
WALK = "walk around what moves, a step for each second, with the camera on it, rather than stand or turn on the spot"
CLOSER = "stand neighbouring cameras within 10 to 15 degrees of each other, or walk a bit with each before it stands"
SLOWLY = "film in one take, slowly, so that each frame shows most of the one before"


@dataclass(frozen=True)
class StructureSettings:
    """How cameras are found.

    Raises:
        ValueError: for an unknown lens or way of matching.
    """

    lens: str = "RADIAL"  # COLMAP's name of its model, one lens for each film; OPENCV placed cameras no better
    matching: str = "auto"  # see `image_pairs`
    masks: Path | None = None  # folder of images named as the frames: black is what moves, and not used here

    def __post_init__(self) -> None:
        check_choice("lens", self.lens, LENSES)
        check_choice("matching", self.matching, MATCHINGS)
        if self.masks is not None and not self.masks.is_dir():
            raise ValueError(f"masks: {self.masks} is no folder; give one with a mask for each frame")


def load_pycolmap() -> ModuleType:
    """COLMAP; ValueError that says how to install it."""
    try:
        import pycolmap
    except ImportError as error:
        raise ValueError(f"pycolmap is needed and cannot be loaded ({error}): pip install -e '.[capture]'") from error
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    return pycolmap


def find_structure(
    frames: Sequence[ChosenFrame], images: Path, work: Path, settings: StructureSettings, *, is_ordered: bool
) -> list[Any]:
    """Models that share no camera, each a `pycolmap.Reconstruction`, the largest first.

    Features and matches that are in `work` already are kept.

    Raises:
        ValueError: that says what is wrong with the film, and what to film instead.
    """
    work.mkdir(parents=True, exist_ok=True)
    database = work / "database.db"
    masks = None if settings.masks is None else _masks(frames, work / "masks", settings.masks)
    _extract(database, frames, images, settings.lens, masks)
    films: dict[int, list[str]] = {}
    for frame in frames:
        films.setdefault(frame.film, []).append(frame.name)
    matching = "exhaustive" if settings.matching == "auto" and not is_ordered else settings.matching
    _match(database, image_pairs(list(films.values()), matching), work / "pairs.txt")
    _check_matches(database, frames)
    models = _map(database, images, work / "models", len(frames))
    if not models and len(films) > 1:
        raise ValueError(f"no camera could be placed: the {len(films)} films show too little in common; {CLOSER}")
    if not models:
        raise ValueError(f"no camera could be placed: the camera turns on the spot, or jumps; {WALK}; {SLOWLY}")
    return sorted(models, key=lambda model: -model.num_reg_images())


def _masks(frames: Sequence[ChosenFrame], target: Path, masks: Path) -> Path:
    """A folder of masks as COLMAP wants them, each named as its image and `.png`."""
    for frame in frames:
        stem = frame.name.removesuffix(".png")
        found = next((path for end in (".png", ".jpg", ".png.png") if (path := masks / f"{stem}{end}").is_file()), None)
        if found is None:
            raise ValueError(f"masks: {masks} must hold a mask for each frame, {stem}.png is missing")
        kept = np.where(read_mask(found, frame.size) > 127, 255, 0).astype(np.uint8)
        (target / frame.name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(kept).save(target / f"{frame.name}.png")
    return target


def _extract(database: Path, frames: Sequence[ChosenFrame], images: Path, lens: str, masks: Path | None) -> None:
    """Find features; all frames of one film and size share one lens."""
    pycolmap, cameras = load_pycolmap(), dict[tuple[Any, ...], int]()
    for frame in tqdm(frames, "features", unit="frame"):
        key = (frame.film, frame.size)
        options = pycolmap.ImageReaderOptions(camera_model=lens, existing_camera_id=cameras.get(key, -1))
        if masks is not None:
            options.mask_path = masks
        pycolmap.extract_features(
            database, images, image_names=[frame.name], camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=options, device=pycolmap.Device.cpu,
        )  # fmt: skip
        if key not in cameras:
            with pycolmap.Database.open(database) as opened:
                cameras[key] = opened.read_image_with_name(frame.name).camera_id


def _match(database: Path, pairs: Sequence[tuple[str, str]], listed: Path) -> None:
    """Match features of pairs and keep what agrees with one motion of the camera."""
    pycolmap = load_pycolmap()
    with tqdm(total=len(pairs), desc="matches", unit="pair") as bar:
        for start in range(0, len(pairs), BATCH):
            batch = pairs[start : start + BATCH]
            listed.write_text("".join(f"{first} {second}\n" for first, second in batch))
            options = pycolmap.ImportedPairingOptions(match_list_path=listed)
            pycolmap.match_image_pairs(database, pairing_options=options, device=pycolmap.Device.cpu)
            bar.update(len(batch))


def _check_matches(database: Path, frames: Sequence[ChosenFrame]) -> None:
    """Raise ValueError for a film without texture, without anything in common, or without motion of the camera."""
    pycolmap = load_pycolmap()
    with pycolmap.Database.open(database) as opened:
        points = {image.image_id: opened.read_keypoints(image.image_id) for image in opened.read_all_images()}
        geometries = list(zip(*opened.read_two_view_geometries()))
    median = float(np.median([len(found) for found in points.values()]))
    if median < LEAST_FEATURES:
        raise ValueError(f"too little texture: {median:.0f} features in the median frame; {TEXTURE}")
    shifts = []  # of matched features between two frames, the median of each pair
    for pair, geometry in geometries:
        matches = np.asarray(geometry.inlier_matches)
        if len(matches) >= LEAST_INLIERS:
            first, second = pycolmap.pair_id_to_image_pair(pair)
            moved = points[first][matches[:, 0], :2] - points[second][matches[:, 1], :2]
            shifts.append(float(np.median(np.hypot(*moved.T))))
    if not shifts:
        raise ValueError(f"frames show nothing in common: no two could be matched; {SLOWLY}; {TEXTURE}")
    shift = max(shifts) / float(np.hypot(*frames[0].size))
    if shift < LEAST_SHIFT:
        raise ValueError(f"the camera stands still: images move by {shift:.1%} of their diagonal at most; {WALK}")


def _map(database: Path, images: Path, unfinished: Path, num_frames: int) -> list[Any]:
    pycolmap = load_pycolmap()
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir()
    options = pycolmap.IncrementalPipelineOptions(
        min_model_size=min(10, max(3, num_frames // 4)), random_seed=0, extract_colors=False
    )
    with tqdm(total=num_frames, desc="cameras", unit="frame") as bar:
        models = pycolmap.incremental_mapping(
            database, images, unfinished, options=options, next_image_callback=lambda: bar.update(1)
        )
    shutil.rmtree(unfinished)
    for model in models.values():
        _refine(model)
    return list(models.values())


def _refine(model: Any) -> None:
    """Adjust cameras and points once more, by errors whose tails hardly count: what moves has matches, too."""
    pycolmap = load_pycolmap()
    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = ROBUST
    for number in model.reg_image_ids():
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()  # its short form writes to the log
    model.update_point_3d_errors()


def keep_good_points(model: Any) -> None:
    """Drop the points of a model that few frames see, or that lie off: they tell nothing of where surfaces are."""
    for number, point in list(model.points3D.items()):
        if point.track.length() < GOOD_TRACK or point.error > GOOD_ERROR:
            model.delete_point3D(number)
