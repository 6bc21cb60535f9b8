"""Fish-eye cameras: lens, response, vignetting (calibration/fisheye.yaml of docs/formats.md 1)."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import msgpack
import numpy as np
import yaml
from jaxtyping import Float32, Float64
from numpy.polynomial.polynomial import polyval

from deltalight.protocol.camera_model import camera_from_info, save_camera_yaml
from deltalight.protocol.documents import nearest, read_mapping
from deltalight.protocol.equidistant_lens import EquidistantLens
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.ocam_lens import OcamLens, load_ocam_results
from deltalight.protocol.response_table import load_response_table, require_response

FisheyeLens = EquidistantLens | OcamLens
_LENSES: dict[str, type[EquidistantLens] | type[OcamLens]] = {
    "equidistant": EquidistantLens,
    "ocam": OcamLens,
}


@dataclass(frozen=True, eq=False)
class FisheyeCalibration:
    """Lens, response and vignetting of a fish-eye camera.

    `response` is linear R G B for each code, 1.0 = white (None = sRGB). `vignetting` holds (v1, v2, ...): at the
    angle a (radians) from the axis the sensor receives 1 + v1 a^2 + v2 a^4 + ... of the light that it receives on the
    axis; radiance = linear / vignetting. As a function of the angle it applies to any size of the picture.

    Raises:
        DeltalightError: the response is not a table, or the vignetting is not positive within 90 degrees.
    """

    lens: FisheyeLens
    response: Float32[np.ndarray, "256 3"] | None = None
    vignetting: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.response is not None:
            object.__setattr__(self, "response", require_response(self.response, "the fish-eye's `response`"))
        object.__setattr__(self, "vignetting", tuple(float(v) for v in self.vignetting))
        if self.vignetting:
            self._check_vignetting()

    def _check_vignetting(self) -> None:
        transmission = self.transmission(np.linspace(0.0, self._seen_angle(), 181))
        if not (np.isfinite(transmission).all() and transmission.min() > 0):
            raise DeltalightError(
                "the fish-eye's `vignetting` is not positive up to 90 degrees; give coefficients of the angle in "
                "radians, [v1, v2, ...] of 1 + v1 a^2 + v2 a^4 + ..."
            )

    def _seen_angle(self) -> float:
        """Largest angle from the axis within the picture, at most 90 degrees."""
        lens = self.lens
        angles = np.linspace(0.0, np.pi / 2, 181)
        around = np.linspace(0.0, 2 * np.pi, 36, endpoint=False)
        a, b = (v.ravel() for v in np.meshgrid(angles, around))
        rays = np.column_stack([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)])
        seen = np.isfinite(lens.project(rays)).all(axis=1)
        return float(a[seen].max(initial=0.0))

    def transmission(self, angle: Float64[np.ndarray, "*shape"]) -> Float64[np.ndarray, "*shape"]:
        """Returns the vignetting at angles from the axis (radians): 1 on the axis."""
        return np.asarray(polyval(np.square(angle), np.array([1.0, *self.vignetting])))

    def __eq__(self, other: object) -> bool:
        """Compares by value."""
        return isinstance(other, FisheyeCalibration) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash((repr(self.lens.to_dict()), self.vignetting))

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values that msgpack, JSON and YAML can hold."""
        return {
            "lens": self.lens.to_dict(),
            "vignetting": list(self.vignetting),
            "response": None if self.response is None else self.response.tolist(),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Creates the calibration from the data of `to_dict`.

        Raises:
            DeltalightError: a key is missing or has an impossible value.
        """
        lens = data.get("lens")
        if not isinstance(lens, Mapping):
            raise DeltalightError("a fish-eye calibration has no `lens`; send all of its fields.")
        kind = lens.get("distortion_model")
        return cls(
            _lens_class(kind).from_dict(lens), data.get("response"), _coefficients(data.get("vignetting"))
        )


def _lens_class(kind: object) -> type[EquidistantLens] | type[OcamLens]:
    if not isinstance(kind, str) or kind not in _LENSES:
        hint = nearest(str(kind), _LENSES)
        raise DeltalightError(
            f"the fish-eye lens model `{kind}` is unknown; use {f'`{hint}`' if hint else 'equidistant or ocam'}."
        )
    return _LENSES[kind]


def _coefficients(values: object) -> tuple[float, ...]:
    try:
        return tuple(float(v) for v in values) if values is not None else ()  # type: ignore[attr-defined]
    except (TypeError, ValueError):
        raise DeltalightError("the fish-eye's `vignetting` must be a list of numbers; correct it.") from None


def load_fisheye_yaml(path: Path) -> FisheyeCalibration:
    """Reads calibration/fisheye.yaml: the keys of ROS camera_info with `distortion_model` equidistant or ocam.

    Instead of `camera_matrix` and `distortion_coefficients`, an ocam lens has `ocam: {polynomial, center [x, y],
    affine [c, d, e]}` or the name of OCamCalib's calib_results.txt beside this file. Optional: `image_circle` (radius
    in pixels), `vignetting` (coefficients), `response` (256 rows of linear R G B, or the name of a text file with
    them beside this one).

    Raises:
        DeltalightError: the file or one of its keys is missing or wrong.
    """
    info = read_mapping(path)
    try:
        lens = _lens_from_info(info, path)
        return FisheyeCalibration(lens, _response(info, path), _coefficients(info.get("vignetting")))
    except DeltalightError as error:
        sentence = str(error)
        raise DeltalightError(sentence if str(path) in sentence else f"{path}: {sentence}") from error


def _lens_from_info(info: Mapping[str, Any], path: Path) -> FisheyeLens:
    kind = info.get("distortion_model")
    if _lens_class(kind) is EquidistantLens:
        return EquidistantLens(camera_from_info(info, path), info.get("image_circle"))
    ocam, circle = info.get("ocam"), info.get("image_circle")
    if isinstance(ocam, str):
        return replace(load_ocam_results(path.parent / ocam), image_circle=circle)
    if not isinstance(ocam, Mapping):
        raise DeltalightError("an ocam lens needs the key `ocam` with polynomial, center and affine; add it.")
    size = {"width": info.get("image_width"), "height": info.get("image_height")}
    return OcamLens.from_dict({**ocam, **size, "image_circle": circle})


def _response(info: Mapping[str, Any], path: Path) -> Float32[np.ndarray, "256 3"] | None:
    value = info.get("response")
    if isinstance(value, str):
        return load_response_table(path.parent / value)
    return None if value is None else require_response(value, "`response`")


def save_fisheye_yaml(path: Path, calibration: FisheyeCalibration) -> None:
    """Writes calibration/fisheye.yaml, which `load_fisheye_yaml` reads back to an equal calibration."""
    lens, described = calibration.lens, calibration.to_dict()
    extra: dict[str, object] = {}
    if lens.image_circle is not None:
        extra["image_circle"] = lens.image_circle
    extra |= {key: described[key] for key in ("vignetting", "response") if described[key]}
    if isinstance(lens, EquidistantLens):
        save_camera_yaml(path, lens.camera, "fisheye", extra)
        return
    info = {
        "image_width": lens.width,
        "image_height": lens.height,
        "camera_name": "fisheye",
        "distortion_model": "ocam",
        "ocam": {key: described["lens"][key] for key in ("polynomial", "center", "affine")},
        **extra,
    }
    path.write_text(yaml.safe_dump(info, sort_keys=False, default_flow_style=None), encoding="utf-8")


def describe_calibration(calibration: FisheyeCalibration) -> tuple[dict[str, object], bytes | None]:
    """Returns the calibration without its response as plain data, and the response (None = sRGB).

    The response is 256 x 3 little-endian 32-bit floats.
    """
    response = calibration.response
    table = None if response is None else response.astype("<f4").tobytes()
    return {**calibration.to_dict(), "response": None}, table


def calibration_of(description: Mapping[str, object], response: bytes | None) -> FisheyeCalibration:
    """Creates the calibration from the data of `describe_calibration`; equal data give the same object.

    Raises:
        DeltalightError: a value is impossible.
    """
    return _calibration(msgpack.packb(description), response)


# A lens caches costly results, and cameras do not change from picture to picture; few are in use at once.
@lru_cache(maxsize=8)
def _calibration(description: bytes, response: bytes | None) -> FisheyeCalibration:
    try:
        calibration = FisheyeCalibration.from_dict(msgpack.unpackb(description))
    except (ArithmeticError, ValueError) as error:  # numbers that overflow in the lens's polynomial
        raise DeltalightError(
            f"the fish-eye calibration holds numbers that no lens has ({error}); calibrate again."
        ) from error
    if response is None:
        return calibration
    table = np.frombuffer(response, "<f4").reshape(-1, 3)
    return replace(calibration, response=require_response(table, "the fish-eye's response"))
