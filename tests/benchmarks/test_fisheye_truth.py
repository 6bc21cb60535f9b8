"""Fish-eye light against truth: where the lamp is, how strong it is, and how close relighting comes with it."""

import importlib.util

import numpy as np
import pytest
from rich.progress import Progress

from deltalight.benchmarks.ground_truth.scenes import scene_named
from deltalight.benchmarks.ground_truth.truth import Truth, ensure_truth
from deltalight.benchmarks.quality.case import SceneCase
from deltalight.benchmarks.quality.metrics import Comparison
from deltalight.benchmarks.variants import FIXED, parse_variants
from deltalight.protocol.frames import LUMINANCE, ViewFrame
from deltalight.protocol.scene_lights import Lights
from deltalight.protocol.scene_lights import SphereLight as GivenSphere
from deltalight.protocol.scene_method import DvctMethod
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.lights.light_models import IncidentLight, SphereLight, incident_light
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.lights.sources import FisheyeSource
from deltalight.render_server.renderer import SceneRenderer

if importlib.util.find_spec("mitsuba") is None:
    pytest.skip("Mitsuba is not installed (dev extra)", allow_module_level=True)

pytestmark = pytest.mark.slow
SIZE = (320, 240)  # smaller, hardly a pixel shows nothing but paper
LIGHT_PATHS = 32
ANGLE_DEG, IRRADIANCE_FRACTION, LOSS_DB = 3.0, 0.05, 3.0  # the project's goals
SCENES = ("two_lights", "cornell")


@pytest.fixture(scope="module", params=SCENES)
def case(request: pytest.FixtureRequest) -> SceneCase:
    """With truth that other modules may have made, of the same size and light paths."""
    with Progress(disable=True) as progress:
        truth: Truth = ensure_truth(
            scene_named(request.param),
            size=SIZE,
            spp=LIGHT_PATHS,
            progress=progress,
        )
    return SceneCase.opened(truth)


def probe(view: ViewFrame) -> np.ndarray:
    assert view.radiance_map is not None
    return view.radiance_map.world_from_fisheye[:3, 3]


def given(case: SceneCase) -> list[IncidentLight]:
    """The scene's lamps as seen from the fish-eye camera, the strongest first."""
    lamps = [lamp for lamp in case.truth.document(0).lights.manual if isinstance(lamp, GivenSphere)]
    spheres = [
        SphereLight(
            np.array(lamp.position_m, np.float32),
            np.array(lamp.color_linear, np.float32) * np.float32(lamp.intensity),
            lamp.radius_m,
        )
        for lamp in lamps
    ]
    return strongest_first([incident_light(sphere, probe(case.views[0])) for sphere in spheres])


def strongest_first(lights: list[IncidentLight]) -> list[IncidentLight]:
    return sorted(lights, key=lambda light: -float(light.irradiance @ LUMINANCE))


def found(view: ViewFrame, distance_m: float | str) -> LightSet:
    lights = FisheyeSource(
        Lights.model_validate({"mode": "fisheye", "fisheye": {"distance_m": distance_m}})
    ).update(view)
    assert lights is not None
    return lights


def test_lamps_are_where_they_are_and_as_strong(case: SceneCase) -> None:
    """No factor is between them: both cameras have the same reference exposure."""
    view, lamps = case.views[0], given(case)
    lights = strongest_first([incident_light(one, probe(view)) for one in found(view, "far").lights])
    assert len(lights) == len(lamps)
    for light, lamp in zip(lights, lamps, strict=True):
        assert np.degrees(np.arccos(min(1.0, float(light.to_light @ lamp.to_light)))) < ANGLE_DEG
        assert light.irradiance @ LUMINANCE == pytest.approx(
            lamp.irradiance @ LUMINANCE, rel=IRRADIANCE_FRACTION
        )
        assert light.irradiance == pytest.approx(lamp.irradiance, rel=2 * IRRADIANCE_FRACTION)


def test_paper_tells_the_lamps_distance(case: SceneCase) -> None:
    view = case.views[0]
    for light in found(view, "auto").lights:
        assert isinstance(light, SphereLight)
        distance = np.linalg.norm(light.position - probe(view))
        nearest = min(
            np.linalg.norm(light.position - lamp.position_m)
            for lamp in case.truth.document(0).lights.manual
            if isinstance(lamp, GivenSphere)
        )
        assert nearest < 0.25 * distance


def test_relighting_is_about_as_good_as_with_the_lamps_known(gpu: GpuContext, case: SceneCase) -> None:
    everywhere = np.ones(case.references[0].shape[:2], bool)
    psnr_db = {}
    for name in ("exact", "fisheye"):
        renderer = SceneRenderer(gpu, FIXED[name].applied(case.truth.document(0), 32))
        picture = renderer.render(case.views[0]).color
        renderer.release()
        psnr_db[name] = Comparison(picture, case.references[0]).over(everywhere).psnr_db
    assert psnr_db["fisheye"] > psnr_db["exact"] - LOSS_DB


def test_fisheye_is_a_method_to_compare(case: SceneCase) -> None:
    (variant,) = parse_variants("fisheye")
    changed = variant.applied(case.truth.document(0), 64)
    assert changed.lights.mode == "fisheye"
    assert changed.lights.resolved_registration == "auto"
    assert isinstance(changed.method, DvctMethod)
    assert changed.method.volume_size == 64
