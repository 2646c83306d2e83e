"""Lens distortion: how a camera bends the directions that it sees, in the terms of OpenCV and COLMAP."""

from dataclasses import dataclass

from dnerf.core.checks import check_choice

MODELS = ("opencv", "fisheye")


@dataclass(frozen=True)
class Distortion:
    """Coefficients of a lens.

    "opencv": `x' = x s + 2 p1 x y + p2 (r^2 + 2 x^2)`, `y' = y s + p1 (r^2 + 2 y^2) + 2 p2 x y` with
    `s = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)`, x right and y down in the plane at depth 1.
    "fisheye" (Kannala and Brandt 2006): `theta' = theta (1 + k1 theta^2 + ... + k4 theta^8)`, theta from the axis.
    Source: OpenCV, calib3d, "Camera Calibration and 3D Reconstruction" and "Fisheye camera model".

    Raises:
        ValueError: for an unknown model, too many coefficients, or tangential ones of a fisheye lens.
    """

    model: str = "opencv"
    radial: tuple[float, ...] = ()  # k1, k2, ...: at most six of opencv, four of fisheye
    tangential: tuple[float, float] = (0.0, 0.0)  # p1, p2

    def __post_init__(self) -> None:
        check_choice("model", self.model, MODELS)
        most = 6 if self.model == "opencv" else 4
        if len(self.radial) > most:
            raise ValueError(f"radial must be at most {most} coefficients of a {self.model} lens, got {self.radial}")
        if self.model == "fisheye" and any(self.tangential):
            raise ValueError(f"tangential must be 0 of a fisheye lens, got {self.tangential}")
