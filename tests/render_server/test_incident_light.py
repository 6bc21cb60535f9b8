"""What lights look like from places: as closed forms say, and the same for many places as for one."""

import numpy as np
import pytest

from deltalight.render_server.lights.light_models import (
    DirectionalLight,
    Light,
    RectangleLight,
    SphereLight,
    SpotLight,
    incident_light,
)

WHITE = np.ones(3, np.float32)
DOWN, HIGH = np.array([0, 0, -1], np.float32), np.array([0, 0, 2], np.float32)
LIGHTS: dict[str, Light] = {
    "directional": DirectionalLight(DOWN, 3 * WHITE, 0.005),
    "sphere": SphereLight(HIGH, 8 * WHITE, 0.1),
    "spot": SpotLight(HIGH, DOWN, 8 * WHITE, 0.1, float(np.radians(30)), 0.5),
    "rectangle": RectangleLight(
        HIGH, np.array([0, 0.3, 0], np.float32), np.array([0.2, 0, 0], np.float32), 5 * WHITE
    ),
}
BELOW = np.zeros(3)


@pytest.mark.parametrize("kind", LIGHTS)
def test_many_places_at_once_are_as_each_by_itself(kind: str) -> None:
    places = np.random.default_rng(1).uniform(-1.5, 1.5, (4, 5, 3))
    many = incident_light(LIGHTS[kind], places)
    assert many.to_light.shape == many.irradiance.shape == (4, 5, 3)
    assert many.angular_radius_rad.shape == (4, 5)
    for row, column in np.ndindex(4, 5):
        one = incident_light(LIGHTS[kind], places[row, column])
        assert one.to_light == pytest.approx(many.to_light[row, column])
        assert one.irradiance == pytest.approx(many.irradiance[row, column])
        assert float(one.angular_radius_rad) == pytest.approx(many.angular_radius_rad[row, column])


@pytest.mark.parametrize(
    ("kind", "irradiance", "radius"),
    [
        ("directional", 3, 0.005),
        ("sphere", 8 / 4, np.arcsin(0.05)),
        ("spot", 8 / 4, np.arcsin(0.05)),
        ("rectangle", 5 * 0.06 / 4, np.arctan(np.sqrt(0.06 / np.pi) / 2)),
    ],
)
def test_lights_straight_above(kind: str, irradiance: float, radius: float) -> None:
    seen = incident_light(LIGHTS[kind], BELOW)
    assert seen.to_light == pytest.approx([0, 0, 1])
    assert seen.irradiance == pytest.approx(irradiance)
    assert float(seen.angular_radius_rad) == pytest.approx(radius)


def test_a_spot_fades_between_its_angles_and_a_rectangle_shines_to_one_side() -> None:
    def at(light: Light, degrees: float) -> float:
        """Irradiance one metre from the light, this far from its axis."""
        angle = np.radians(degrees)
        return float(incident_light(light, HIGH + np.array([np.sin(angle), 0, -np.cos(angle)])).irradiance[0])

    spot, rectangle = LIGHTS["spot"], LIGHTS["rectangle"]
    found = [at(spot, degrees) for degrees in (14, 22.5, 31)]
    assert found == pytest.approx([8, 4, 0], rel=1e-6)
    assert at(rectangle, 60) == pytest.approx(0.5 * at(rectangle, 0), rel=1e-6)
    assert at(rectangle, 120) == 0


def test_at_the_middle_of_a_light_nothing_is_infinite() -> None:
    for light in (LIGHTS["sphere"], LIGHTS["spot"], LIGHTS["rectangle"]):
        seen = incident_light(light, HIGH.astype(float))
        assert np.isfinite(seen.irradiance).all()
        assert np.isfinite(seen.to_light).all()
