"""How close a rendered image is to the true one: PSNR, SSIM, LPIPS."""

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from dnerf.core.checks import check_choice, check_shape

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
# Files of the backbones' ImageNet weights, as torchvision names them in torch's hub folder.
BACKBONES = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth"}


def psnr(prediction: Tensor, target: Tensor) -> float:
    """Peak signal-to-noise ratio in dB: `-10 log10(mean((prediction - target)^2))`.

    The mean runs over all pixels and channels. The prediction is clamped to [0, 1] first, as saving it as an image
    would; it is not rounded to 8 bits. A plain number, +inf for identical images, NaN if one holds a NaN.

    Args:
        prediction: (..., 3) or any shape, float.
        target: same shape, in [0, 1]; ValueError if shapes differ or there is nothing to compare.
    """
    prediction, target = _comparable(prediction, target)
    return float(-10 * (prediction - target).square().mean().log10())


def ssim(prediction: Tensor, target: Tensor) -> float:
    """Mean structural similarity (Wang et al. 2004) of two images, through torchmetrics; 1 for identical images.

    Protocol: RGB, each channel on its own, Gaussian window of 11 x 11 with sigma 1.5, K1 = 0.01, K2 = 0.03, data range
    1, population variances, mean over channels and all pixels, images reflected by 5 pixels at their edges. This is
    what torchmetrics reports since 1.6 (and nerfstudio with it); implementations that leave the outer 5 pixels out
    (Wang's, skimage's, multinerf's) differ in the third digit. The prediction is clamped to [0, 1] first.

    Args:
        prediction: (H, W, 3) float, H and W at least 11; ValueError otherwise.
        target: same shape, in [0, 1].
    """
    # The import takes over a second, and training does without.
    from torchmetrics.functional.image import structural_similarity_index_measure

    prediction, target = _comparable(prediction, target)
    if prediction.dim() != 3 or prediction.shape[-1] != 3 or min(prediction.shape[:2]) < SSIM_WINDOW:
        raise ValueError(
            f"prediction must have shape (H, W, 3) with H and W at least {SSIM_WINDOW}, got {tuple(prediction.shape)}"
        )
    first, second = (image.movedim(-1, 0)[None] for image in (prediction, target))
    # torchmetrics before 1.6 leaves the outer pixels out of the mean, but not out of the map.
    _, similarities = structural_similarity_index_measure(
        first, second, sigma=SSIM_SIGMA, kernel_size=SSIM_WINDOW, data_range=1.0, return_full_image=True
    )
    return float(similarities.mean())


def lpips_metric(backbone: str = "alex", *, download: bool = False) -> Callable[[Tensor, Tensor], float]:
    """A function of prediction and target, (H, W, 3) in [0, 1], that gives their LPIPS distance, clamped first.

    Source: Zhang et al., "The unreasonable effectiveness of deep features as a perceptual metric" (CVPR 2018), with
    version 0.1 of its linear heads, which torchmetrics carries. Distances of the two backbones are not comparable.

    Args:
        backbone: "alex" or "vgg".
        download: let torchvision fetch the backbone's weights (233 or 528 MB) if they are not there.

    Raises:
        ValueError: saying what to do, if the extra is not installed, torchvision is of another build than torch, or the
            weights are not at hand, cannot be fetched or are damaged.
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
        first, second = (image.float().clamp(0, 1).movedim(-1, 0)[None] for image in (prediction, target))
        value = float(on_device(first, second))
        on_device.reset()
        return value

    return distance


def _comparable(prediction: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Both in one precision, single or double, the prediction clamped to [0, 1]."""
    if prediction.shape != target.shape or not prediction.numel():
        raise ValueError(
            "prediction and target must have the same shape and not be empty, "
            f"got {tuple(prediction.shape)} and {tuple(target.shape)}"
        )
    dtype = torch.promote_types(torch.promote_types(prediction.dtype, target.dtype), torch.float32)
    return prediction.to(dtype).clamp(0, 1), target.to(dtype)
