"""Paths work as people type them, and a data set is drawn as it is understood."""

import importlib
from pathlib import Path

import imageio.v3 as iio
import pytest
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra_app import quoted_path
from hypothesis import given
from hypothesis import strategies as st
from launcher import ROOT

from dnerf.data import SyntheticData, save_blender
from dnerf.scenes import make_scene


def understood(word: str) -> object:
    """What Hydra makes of a word."""
    return OverridesParser.create().parse_override(word).value()


@pytest.mark.parametrize(
    "path",
    [
        "my scenes/lego (1)", "a=b#c", "it's", 'the "best"', "[new]", "{x: 1}", "数据/场景", "C:\\data\\x\\", "2024",
        "1e5", "true", "null_island", "a,b", "$HOME", "50%", "a\\'b", "-lead", "*", "a;b|c&d", "./runs/x", "../x",
    ],
)  # fmt: skip
@pytest.mark.parametrize("key", ["data.root", "out_dir", "run", "+data_root"])
def test_a_path_reaches_the_program_as_it_was_typed(key: str, path: str) -> None:
    value = understood(quoted_path(f"{key}={path}"))
    assert getattr(value, "text", value) == path


@given(st.text(st.characters(exclude_categories=("Cs", "Cc")), min_size=1).filter(lambda text: text[0] not in "'\"~"))
def test_any_printable_path_does(path: str) -> None:
    if path in ("null", "???") or "${" in path:
        return
    value = understood(quoted_path(f"data.root={path}"))
    assert getattr(value, "text", value) == path


def test_the_home_folder_is_found_and_what_is_no_path_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/some one")
    value = understood(quoted_path("data.root=~/scenes"))
    assert getattr(value, "text", value) == "/home/some one/scenes"
    for word in (
        "seed=0,1", "data.box=[[0,0,0],[1,1,1]]", "out_dir=null", "data.root='as it is'", "--multirun", "~a.b",
    ):  # fmt: skip
        assert quoted_path(word) == word
    assert quoted_path("data.root=a,b", is_sweep=True) == "data.root=a,b"
    assert quoted_path("data.root=${oc.env:DNERF_DATA}/x") == "data.root=${oc.env:DNERF_DATA}/x"


def test_check_data_says_and_draws_what_is_understood(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source = SyntheticData(make_scene("static"), 16, num_train=6, num_test=2, num_val=1)
    save_blender({split: source.frames(split) for split in ("train", "test")}, tmp_path / "my scene")
    monkeypatch.chdir(tmp_path)
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        config = compose("check_data", [quoted_path("data.root=my scene")])
    importlib.import_module("check_data").main(config)
    said = capsys.readouterr().out
    for line in (
        "format: blender", "train: 6 frames of 16 x 16", "test: 2 frames", "lens: ", "box: [[", "planes: ", "up: ",
    ):  # fmt: skip
        assert line in said
    assert iio.imread(tmp_path / "check_data.png").shape == (960, 1440, 3)
