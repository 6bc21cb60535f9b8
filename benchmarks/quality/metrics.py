"""Agreement of 8-bit coded pictures: PSNR, SSIM and FLIP, over the picture and over parts of it."""

from dataclasses import dataclass

import flip_evaluator
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from skimage.metrics import structural_similarity

CODE_RANGE = 255.0
SSIM_SIGMA = 1.5
"""Standard deviation of SSIM's window, pixels, as in the original (Wang et al. 2004)."""

Picture = UInt8[np.ndarray, "h w 3"]
Mask = Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class Agreement:
    """Agreement of a part of a picture with its reference.

    `share` of the picture's pixels; `psnr_db` is infinite if nothing differs; `ssim` 1 is perfect; `flip` 0 is. All
    but `share` are nan if the part is empty.
    """

    share: float
    psnr_db: float
    ssim: float
    flip: float


class Comparison:
    """A picture against its reference, both camera-coded, of one size."""

    def __init__(self, picture: Picture, reference: Picture) -> None:
        self._squares = np.square(picture.astype(np.float64) - reference).mean(axis=2)
        self._ssim = ssim_map(picture, reference)
        self._flip = flip_map(picture, reference)

    def over(self, mask: Mask) -> Agreement:
        """Returns the agreement over the pixels of a mask. SSIM and FLIP include neighbours outside it."""
        if not mask.any():
            return Agreement(0.0, np.nan, np.nan, np.nan)
        return Agreement(
            share=float(mask.mean()),
            psnr_db=decibels(float(self._squares[mask].mean())),
            ssim=float(self._ssim[mask].mean()),
            flip=float(self._flip[mask].mean()),
        )

    def everywhere(self) -> Agreement:
        """Returns the agreement over the whole picture."""
        return self.over(np.ones(self._squares.shape, bool))


def decibels(mean_square: float) -> float:
    """Returns the peak signal to noise ratio of a mean squared error in 8-bit codes, dB; infinite for 0."""
    return float(10 * np.log10(CODE_RANGE**2 / mean_square)) if mean_square > 0 else np.inf


def ssim_map(picture: Picture, reference: Picture) -> Float64[np.ndarray, "h w"]:
    """Returns the structural similarity of each pixel's neighbourhood, mean of the channels (Wang et al. 2004)."""
    _, similarity = structural_similarity(
        reference,
        picture,
        gaussian_weights=True,
        sigma=SSIM_SIGMA,
        use_sample_covariance=False,
        data_range=CODE_RANGE,
        channel_axis=2,
        full=True,
    )
    return np.asarray(similarity.mean(axis=2), np.float64)


def flip_map(picture: Picture, reference: Picture) -> Float32[np.ndarray, "h w"]:
    """Returns FLIP of each pixel, 0..1, at its default of 67 pixels per degree (Andersson et al. 2020)."""
    pair = [np.asarray(codes / CODE_RANGE, np.float32) for codes in (reference, picture)]
    found, _, _ = flip_evaluator.evaluate(*pair, "LDR", applyMagma=False, computeMeanError=False)
    return np.asarray(found[..., 0], np.float32)
