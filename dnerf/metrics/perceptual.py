"""LPIPS through torchmetrics, for whoever has its weights: nothing is downloaded unless asked for."""

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from dnerf.checks import check_choice, check_shape

BACKBONES = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth"}
"""Files of the backbones' ImageNet weights, as torchvision names them in torch's hub folder."""


def lpips_metric(backbone: str = "alex", *, download: bool = False) -> Callable[[Tensor, Tensor], float]:
    """A function that gives the LPIPS distance of two pictures.

    Source: Zhang et al., "The unreasonable effectiveness of deep features as a perceptual metric" (CVPR 2018), with
    version 0.1 of its linear heads, which torchmetrics carries. Distances of the two backbones are not comparable:
    say which.

    Args:
        backbone: "alex" or "vgg".
        download: let torchvision fetch the backbone's weights (233 or 528 MB) if they are not there.

    Returns:
        A function of prediction and target, (H, W, 3) in [0, 1], that returns a number; the prediction is clamped.

    Raises:
        ValueError: saying what to do, if the extra is not installed, torchvision is of another build than torch, or
            the weights are not at hand, cannot be fetched or are damaged.
    """
    check_choice("backbone", backbone, tuple(BACKBONES))
    try:
        import torchvision  # noqa: F401
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity
    except ImportError as error:
        raise ValueError("lpips needs the extra: pip install 'dnerf[lpips]'") from error
    except RuntimeError as error:  # torch of one build (CPU) and torchvision of another (CUDA)
        reason = str(error).partition("\n")[0]
        raise ValueError(
            f"lpips: torchvision does not fit torch {torch.__version__} ({reason}); "
            "install both from the same index, for the same device"
        ) from error
    weights = Path(torch.hub.get_dir()) / "checkpoints" / BACKBONES[backbone]
    if not weights.is_file() and not download:
        raise ValueError(
            f"lpips: the weights of {backbone} are not at hand; put {BACKBONES[backbone]} into {weights.parent} "
            "or allow the download with lpips.download=true"
        )
    try:
        network = LearnedPerceptualImagePatchSimilarity(net_type=backbone, normalize=True)  # type: ignore[arg-type]
    except Exception as error:
        # What a truncated file raises depends on where it ends.
        what = "read" if weights.is_file() else "fetched"
        raise ValueError(
            f"lpips: the weights of {backbone} could not be {what} ({error}); put a whole {BACKBONES[backbone]} "
            f"into {weights.parent}"
        ) from error
    network.eval()

    @torch.no_grad()
    def distance(prediction: Tensor, target: Tensor) -> float:
        check_shape("prediction", prediction, ("H", "W", 3))
        check_shape("target", target, prediction.shape)
        on_device = network.to(prediction.device)
        first, second = (picture.float().clamp(0, 1).movedim(-1, 0)[None] for picture in (prediction, target))
        value = float(on_device(first, second))
        on_device.reset()
        return value

    return distance
