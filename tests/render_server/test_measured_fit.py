"""Sums of Gaussians for measured BRDFs: known sums are found again, light is kept, bad files are one sentence."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.scene.brdf_fit import fit_brdf, held_out_error
from deltalight.render_server.scene.brdf_measurements import read_brdf
from deltalight.render_server.scene.gaussian_brdf import GaussianBrdf
from deltalight.render_server.scene.material_file import read_material, write_material
from tests.render_server.brdf_samples import brdf_file, brdf_text, directions, grey_brdf

PAINT = grey_brdf(0.3, (0.09, 0.05, 0.4), (0.3, 0.15, 0.3))
SAMPLES = np.random.default_rng(3)


def everywhere(count: int) -> np.ndarray:
    """Random directions above the surface, 10 degrees and more."""
    cosine, turn = SAMPLES.uniform(np.sin(np.radians(10)), 1, count), SAMPLES.uniform(0, 2 * np.pi, count)
    return directions(np.stack([np.arccos(cosine), turn], axis=1))


def test_a_known_sum_is_found_again(tmp_path: Path) -> None:
    samples = read_brdf(brdf_file(tmp_path, PAINT))
    fitted = fit_brdf(samples)
    light, view = everywhere(4000), everywhere(4000)
    known = PAINT.evaluate(light, view)
    error = np.sqrt(((fitted.evaluate(light, view) - known) ** 2).sum() / (known**2).sum())
    print(f"known sum: {error:.3f} r.m.s. elsewhere, {held_out_error(samples)}")
    assert error < 0.03
    assert fitted.hemispherical_albedo == pytest.approx(PAINT.hemispherical_albedo, rel=0.02)
    assert held_out_error(samples).whole < 0.05


def test_a_lambertian_is_found_again(tmp_path: Path) -> None:
    fitted = fit_brdf(read_brdf(brdf_file(tmp_path, grey_brdf(0.6))))
    assert fitted.hemispherical_albedo == pytest.approx(0.6, rel=0.01)
    assert fitted.evaluate(everywhere(500), everywhere(500)) == pytest.approx(0.6 / np.pi, rel=0.02)


def test_it_is_reciprocal(tmp_path: Path) -> None:
    fitted = fit_brdf(read_brdf(brdf_file(tmp_path, PAINT)))
    light, view = everywhere(500), everywhere(500)
    assert fitted.evaluate(light, view) == pytest.approx(fitted.evaluate(view, light), rel=1e-9)


def reflected(brdf: GaussianBrdf, cosine: float) -> float:
    """Of light from everywhere, by a sum over even directions."""
    side = 500
    z = (np.arange(side) + 0.5) / side
    turn = 2 * np.pi * (np.arange(side) + 0.5) / side
    grid = np.stack(np.meshgrid(np.arccos(z), turn), axis=-1).reshape(-1, 2)
    light = directions(grid)
    view = np.tile([np.sqrt(1 - cosine**2), 0, cosine], (len(light), 1))
    return float((brdf.evaluate(light, view)[:, 0] * light[:, 2]).mean() * 2 * np.pi)


@pytest.mark.parametrize("cosine", [0.15, 0.5, 0.95])
def test_its_albedo_is_the_integral(cosine: float) -> None:
    found = PAINT.diffuse[0] + PAINT.lobe_albedo(cosine).sum(axis=0)[0]
    assert found == pytest.approx(reflected(PAINT, cosine), rel=0.005)


def test_no_fit_reflects_more_than_arrives(tmp_path: Path) -> None:
    """Of samples that do, five times too bright."""
    bright = GaussianBrdf(5 * PAINT.diffuse, PAINT.sigmas, 5 * PAINT.weights)
    fitted = fit_brdf(read_brdf(brdf_file(tmp_path, bright)))
    found = [reflected(fitted, cosine) for cosine in (0.05, 0.3, 1.0)]
    assert max(found) < 1.005
    assert fitted.greatest_albedo == pytest.approx(1.0, abs=1e-6)


def test_spectra_become_colours(tmp_path: Path) -> None:
    grey = read_brdf(brdf_file(tmp_path, grey_brdf(0.5))).values
    assert grey == pytest.approx(0.5 / np.pi, rel=1e-4)
    nm = np.arange(400, 701, 10)
    for channel, (low, high) in enumerate([(600, 700), (510, 570), (400, 480)]):
        values = read_brdf(
            brdf_file(tmp_path, grey_brdf(0.5), ((nm >= low) & (nm <= high)).astype(float))
        ).values
        assert np.argmax(values.mean(axis=0)) == channel


def test_a_file_holds_the_material(tmp_path: Path) -> None:
    write_material(tmp_path / "paint.dlmat", PAINT)
    again = read_material(tmp_path / "paint.dlmat")
    for name in ("diffuse", "sigmas", "weights"):
        assert np.array_equal(getattr(again, name), getattr(PAINT, name))
    assert (tmp_path / "paint.dlmat").stat().st_size < 4000


def _cut(content: bytes) -> bytes:
    return content[:-20]


def _newer(content: bytes) -> bytes:
    return content.replace(b"material 1 ", b"material 2 ", 1)


def _turned(content: bytes) -> bytes:
    return content[:-100] + bytes([content[-100] ^ 1]) + content[-99:]


def _mesh(_content: bytes) -> bytes:
    return b"ply\nformat ascii 1.0\n"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (_cut, "is damaged or cut short"),
        (_turned, "is damaged or cut short"),
        (_newer, "is a precomputed material of version 2, and this release reads version 1"),
        (_mesh, "is not a precomputed material; make it with `deltalight precompute"),
    ],
)
def test_bad_material_files(tmp_path: Path, change: Callable[[bytes], bytes], sentence: str) -> None:
    path = tmp_path / "paint.dlmat"
    write_material(path, PAINT)
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(DeltalightError, match=sentence):
        read_material(path)


@pytest.mark.parametrize("broken", ["negative", "nan", "shape"])
def test_numbers_that_are_no_material(tmp_path: Path, broken: str) -> None:
    weights = PAINT.weights.copy()
    weights[0, 0, 0] = {"negative": -1, "nan": np.nan, "shape": 1}[broken]
    made = GaussianBrdf(PAINT.diffuse, PAINT.sigmas, weights[:, :4] if broken == "shape" else weights)
    write_material(tmp_path / "paint.dlmat", made)
    with pytest.raises(DeltalightError, match="holds no material that can be drawn"):
        read_material(tmp_path / "paint.dlmat")


WHOLE = brdf_text(PAINT)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is not a complete .brdf file"),
        ("# only a comment\n", "is not a complete .brdf file"),
        (WHOLE[: len(WHOLE) // 2 - 30], "is not a complete .brdf file"),
        ("ply\nformat ascii 1.0\n", "holds something other than numbers"),
        (WHOLE.replace(" 0.", " nan ", 1), "not finite"),
        (WHOLE.replace(" 0.", " 1e300 ", 1), "beyond 1e"),
        (WHOLE.replace("400 410", "410 400"), "is not a complete .brdf file"),
        ("2\n400 500\n" + "0.1 0 0.2 0 1 1\n" * 200, "from 400 to 500 nm, which gives no colour"),
        (
            "2\n400 700\n" + "0.1 0 0.2 0 1 1\n" * 9,
            "has 9 samples above the surface; a fit needs at least 100",
        ),
    ],
)
def test_bad_measurements(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "paint.brdf"
    path.write_text(text)
    with pytest.raises(DeltalightError, match=sentence):
        read_brdf(path)


def test_no_measurements(tmp_path: Path) -> None:
    with pytest.raises(DeltalightError, match=r"none\.brdf cannot be read"):
        read_brdf(tmp_path / "none.brdf")
