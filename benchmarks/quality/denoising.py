"""Noise out of path-traced pictures: Intel Open Image Denoise (OIDN), as the package `oidn` brings it."""

import ctypes
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from deltalight.benchmarks.ground_truth.render import GuidedPicture
from deltalight.benchmarks.quality.regions import Linear
from deltalight.protocol.errors import DeltalightError

MISSING = "`path+oidn` needs the package oidn; install the project with its dev extra, or leave it out of --methods."


def require_denoiser() -> None:
    """Checks that the denoiser can be loaded.

    Raises:
        DeltalightError: it cannot.
    """
    _library()


class Denoiser:
    """OIDN's filter for path-traced pictures (`RT`) of one size, width and height in pixels; release it after use.

    Raises:
        DeltalightError: the package is missing or cannot be loaded.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        width, height = size
        self._oidn = _library()
        images = ("color", "albedo", "normal", "output")
        self._images = {name: np.zeros((height, width, 3), np.float32) for name in images}
        self._device = self._oidn.NewDevice()
        self._oidn.CommitDevice(self._device)
        self._filter = self._oidn.NewFilter(self._device, "RT")
        for name, image in self._images.items():
            self._oidn.SetSharedFilterImage(
                self._filter, name, image, self._oidn.FORMAT_FLOAT3, width, height
            )
        self._allow_radiance()
        self._oidn.CommitFilter(self._filter)

    def __call__(self, noisy: GuidedPicture) -> Linear:
        """Returns the picture without noise.

        Raises:
            DeltalightError: the denoiser failed.
        """
        for name in ("color", "albedo", "normal"):
            self._images[name][:] = getattr(noisy, name)
        self._oidn.ExecuteFilter(self._filter)
        code = self._oidn.GetDeviceError(self._device)
        if code:
            raise DeltalightError(f"Open Image Denoise failed (error {code}); leave out `path+oidn`.")
        return self._images["output"].copy()

    def release(self) -> None:
        """Frees the filter and its device."""
        self._oidn.ReleaseFilter(self._filter)
        self._oidn.ReleaseDevice(self._device)

    def _allow_radiance(self) -> None:
        """Tells that colour is linear and may exceed 1, for which the package has no function."""
        set_flag = vars(self._oidn)["__lib_oidn"].oidnSetFilter1b
        set_flag.argtypes, set_flag.restype = (ctypes.c_void_p, ctypes.c_char_p, ctypes.c_bool), None
        set_flag(self._filter, b"hdr", True)


def _library() -> Any:  # noqa: ANN401 - a module without types
    package = find_spec("oidn")
    if package is None or package.origin is None:
        raise DeltalightError(MISSING)
    try:
        for threads in Path(package.origin).parent.glob("lib.linux*/libtbb.so*"):
            ctypes.CDLL(str(threads))  # the package lacks the link by which its other library would find it
        import oidn
    except OSError as error:
        raise DeltalightError(
            f"Open Image Denoise does not start here ({error}); leave `path+oidn` out of --methods."
        ) from error
    return oidn
