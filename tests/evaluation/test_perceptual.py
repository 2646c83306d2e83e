"""LPIPS is an extra whose absence is explained; with its library and weights at hand it is a distance."""

import builtins
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from dnerf.evaluation.images import BACKBONES, lpips_metric


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ImportError("No module named 'torchvision'"), r"lpips needs the extra: pip install 'dnerf\[lpips\]'"),
        # PyPI's torchvision next to a CPU torch.
        (
            RuntimeError("operator torchvision::nms does not exist"),
            r"torchvision does not fit torch .*nms does not exist.*same index",
        ),
    ],
)
def test_a_missing_extra_or_one_of_another_build_is_explained(
    monkeypatch: pytest.MonkeyPatch, error: Exception, message: str
) -> None:
    real = builtins.__import__

    def without_torchvision(name: str, *arguments: object, **options: object) -> object:
        if name == "torchvision":
            raise error
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without_torchvision)
    with pytest.raises(ValueError, match=message):
        lpips_metric()


@pytest.mark.parametrize(("at_hand", "said"), [(True, "read"), (False, "fetched")])
def test_damaged_and_unreachable_weights_are_explained(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, at_hand: bool, said: str
) -> None:
    class Network:
        def __init__(self, **options: object) -> None:
            raise OSError("no route to host")

    modules = {"torchvision": SimpleNamespace(), "torchmetrics.image.lpip": SimpleNamespace()}
    modules["torchmetrics.image.lpip"].LearnedPerceptualImagePatchSimilarity = Network
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    if at_hand:
        (tmp_path / "checkpoints").mkdir()
        (tmp_path / "checkpoints" / BACKBONES["alex"]).write_bytes(b"PK")
    with pytest.raises(ValueError, match=rf"could not be {said} \(no route to host\); put a whole {BACKBONES['alex']}"):
        lpips_metric(download=not at_hand)


def test_missing_weights_are_explained_and_never_fetched(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("torchvision", reason="needs the extra: pip install 'dnerf[lpips]'")
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(torch.hub, "download_url_to_file", lambda *_: pytest.fail("it went to the network"))
    with pytest.raises(ValueError, match=rf"put {BACKBONES['alex']} into .* or allow the download with lpips.download"):
        lpips_metric()


def test_an_unknown_backbone_is_named() -> None:
    with pytest.raises(ValueError, match="backbone must be one of alex, vgg; got 'squeeze'"):
        lpips_metric("squeeze")


@pytest.mark.parametrize("backbone", BACKBONES)
def test_lpips_is_a_distance(backbone: str) -> None:
    pytest.importorskip("torchvision", reason="needs the extra: pip install 'dnerf[lpips]'")
    weights = Path(torch.hub.get_dir()) / "checkpoints" / BACKBONES[backbone]
    if not weights.is_file():
        pytest.skip(f"the weights are not at hand: {weights}")
    distance = lpips_metric(backbone)
    image = torch.rand(64, 64, 3)
    assert distance(image, image) == pytest.approx(0, abs=1e-6)
    near, far = distance((image + 0.02).clamp(0, 1), image), distance(torch.rand(64, 64, 3), image)
    assert 0 < near < far
    assert distance(image + 5, torch.ones(64, 64, 3)) == pytest.approx(0, abs=1e-5)  # clamped
