"""How close a rendered picture is to the true one."""

import torch
from torch import Tensor

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5


def psnr(prediction: Tensor, target: Tensor) -> float:
    """Peak signal-to-noise ratio in dB: `-10 log10(mean((prediction - target)^2))`.

    The mean runs over all pixels and channels. The prediction is clamped to [0, 1] first, as saving it as a picture
    would; it is not rounded to 8 bits.

    Args:
        prediction: (..., 3) or any shape, float.
        target: same shape, in [0, 1].

    Returns:
        A plain number, for reports rather than gradients; +inf for identical pictures, NaN if one holds a NaN.

    Raises:
        ValueError: if shapes differ or there is nothing to compare.
    """
    _check_pair(prediction, target)
    dtype = torch.promote_types(torch.promote_types(prediction.dtype, target.dtype), torch.float32)
    error = prediction.to(dtype).clamp(0, 1) - target.to(dtype)
    return float(-10 * error.square().mean().log10())


def ssim(prediction: Tensor, target: Tensor) -> float:
    """Mean structural similarity (Wang et al. 2004) of two pictures, through torchmetrics.

    Protocol: RGB, each channel on its own, Gaussian window of 11 x 11 with sigma 1.5, K1 = 0.01, K2 = 0.03, data
    range 1, population variances, mean over channels and all pixels, pictures reflected by 5 pixels at their edges.
    This is what torchmetrics reports since 1.6 (and nerfstudio with it); implementations that leave the outer 5
    pixels out (Wang's, skimage's, multinerf's) differ in the third digit. The prediction is clamped to [0, 1] first.

    Args:
        prediction: (H, W, 3) float, H and W at least 11.
        target: same shape, in [0, 1].

    Returns:
        A plain number in [-1, 1], for reports rather than gradients; 1 for identical pictures.

    Raises:
        ValueError: if shapes differ, are not (H, W, 3), or are smaller than the window.
    """
    # The import takes over a second, and training does without.
    from torchmetrics.functional.image import structural_similarity_index_measure

    _check_pair(prediction, target)
    if prediction.dim() != 3 or prediction.shape[-1] != 3 or min(prediction.shape[:2]) < SSIM_WINDOW:
        raise ValueError(
            f"prediction must have shape (H, W, 3) with H and W at least {SSIM_WINDOW}, got {tuple(prediction.shape)}"
        )
    dtype = torch.promote_types(torch.promote_types(prediction.dtype, target.dtype), torch.float32)
    # torchmetrics before 1.6 leaves the outer pixels out of the mean, but not out of the map.
    _, similarities = structural_similarity_index_measure(
        prediction.to(dtype).clamp(0, 1).movedim(-1, 0)[None],
        target.to(dtype).movedim(-1, 0)[None],
        gaussian_kernel=True,
        sigma=SSIM_SIGMA,
        kernel_size=SSIM_WINDOW,
        data_range=1.0,
        return_full_image=True,
    )
    return float(similarities.mean())


def _check_pair(prediction: Tensor, target: Tensor) -> None:
    if prediction.shape != target.shape or not prediction.numel():
        raise ValueError(
            "prediction and target must have the same shape and not be empty, "
            f"got {tuple(prediction.shape)} and {tuple(target.shape)}"
        )
