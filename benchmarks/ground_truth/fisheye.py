"""The up-looking fish-eye camera at the virtual object's position: its lens in Mitsuba and its exposure bracket."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from deltalight.benchmarks.ground_truth.sensors import ColorSensor
from deltalight.protocol.camera_model import CameraModel, save_camera_yaml
from deltalight.protocol.dataset_lists import format_timestamp
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.pictures import encode_png

EDGE_PX = 240
FIELD_OF_VIEW_DEG = 190.0
"""Beyond the horizon, as usual for fish-eye lenses that look at the sky."""
CAMERA = CameraModel(
    width=EDGE_PX,
    height=EDGE_PX,
    matrix=np.array(
        [
            [EDGE_PX / np.radians(FIELD_OF_VIEW_DEG), 0.0, (EDGE_PX - 1) / 2],
            [0.0, EDGE_PX / np.radians(FIELD_OF_VIEW_DEG), (EDGE_PX - 1) / 2],
            [0.0, 0.0, 1.0],
        ]
    ),
    distortion_model="equidistant",
    distortion=np.zeros(4),
)
EXPOSURES_S = (1.0, 1 / 32, 1 / 1024)
"""Reference exposure, 1 s: there a linear value is the radiance in camera units. The shortest one still shows lamps
of radiance 1000 (0.1 m wide, they light a table 1 m away to sensor white); each reaches five stops, so what one
clips lies 25 times above the read noise of the next."""


def fisheye_sensor(camera: CameraModel, world_from_camera: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    """Returns Mitsuba's equidistant lens without film.

    Angle from the axis = radius / focal length, even beyond 90 degrees. Its image circle touches the nearest edge of
    the picture; beyond it the picture is black.

    Raises:
        DeltalightError: the lens has distortion coefficients.
    """
    import mitsuba as mi

    if camera.distortion.any():
        raise DeltalightError("the rendered fish-eye lens is exactly equidistant; give zeros as distortion.")
    _register(mi.variant())
    fx, fy, cx, cy = (float(v) for v in camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]])
    lens = {"focal_x": fx, "focal_y": fy, "center_x": cx, "center_y": cy}
    circle = min(camera.width, camera.height) / 2 / min(fx, fy)
    return {
        "type": "equidistant",
        **lens,
        "largest_angle": circle,
        "to_world": mi.ScalarTransform4f(world_from_camera),
    }


@cache
def _register(variant: str) -> None:
    """Creates the plugin `equidistant` for a variant of Mitsuba, whose types are known only once it is set."""
    import drjit as dr
    import mitsuba as mi

    class Equidistant(mi.Sensor):
        """Axes as in OpenCV: x right, y down, z forward."""

        def __init__(self, props: Any) -> None:  # noqa: ANN401 - mi.Properties
            super().__init__(props)
            names = ("focal_x", "focal_y", "center_x", "center_y", "largest_angle")
            self.fx, self.fy, self.cx, self.cy, self.largest = (props[name] for name in names)

        def sample_ray(self, *sample: Any) -> Any:  # noqa: ANN401 - typed by the variant
            """Returns the ray through a position on the film, given as fractions of its size."""
            _time, _wavelength, position, *_ = sample
            size = self.film().size()
            x = (position.x * size[0] - 0.5 - self.cx) / self.fx
            y = (position.y * size[1] - 0.5 - self.cy) / self.fy
            angle = dr.sqrt(x * x + y * y)
            stretch = dr.select(angle > 0, dr.sin(angle) / dr.maximum(angle, 1e-12), 1.0)
            pose = self.world_transform()
            direction = pose @ mi.Vector3f(x * stretch, y * stretch, dr.cos(angle))
            weight = dr.select(angle < self.largest, 1.0, 0.0)
            return mi.Ray3f(mi.Point3f(pose.translation()), direction), mi.Spectrum(weight)

        def sample_ray_differential(self, *sample: Any) -> Any:  # noqa: ANN401 - typed by the variant
            """Returns the same ray; nothing in these scenes needs differentials."""
            ray, weight = self.sample_ray(*sample)
            return mi.RayDifferential3f(ray), weight

    del variant  # only tells registrations apart
    mi.register_sensor("equidistant", Equidistant)


def write_bracket(
    folder: Path, radiance: Float32[np.ndarray, "h w 3"], timestamp_ns: int, rng: np.random.Generator
) -> None:
    """Writes the exposure bracket of a fish-eye picture and its calibration into a dataset (docs/formats.md 1)."""
    (folder / "fisheye").mkdir()
    lines = ["# timestamp filename exposure_s"]
    for number, exposure_s in enumerate(EXPOSURES_S):
        name = f"fisheye/000000-{number}.png"
        picture = ColorSensor().expose(np.asarray(radiance * np.float32(exposure_s)), rng)
        (folder / name).write_bytes(encode_png(picture))
        lines.append(f"{format_timestamp(timestamp_ns)} {name} {exposure_s!r}")
    (folder / "fisheye.txt").write_text("\n".join(lines) + "\n")
    save_camera_yaml(folder / "calibration" / "fisheye.yaml", CAMERA, "fisheye")
