"""BRDFs as a gonioreflectometer would sample them, in Cornell's text format."""

from pathlib import Path

import numpy as np

from deltalight.render_server.scene.gaussian_brdf import GaussianBrdf

WAVELENGTHS = range(400, 701, 10)


def grey_brdf(diffuse: float = 0.2, *lobes: tuple[float, float, float]) -> GaussianBrdf:
    """`lobes`: sigma, weight head-on, weight at grazing angles, between which it rises by Schlick's term."""
    weights = [[[at_zero] * 3] * 5 + [[grazing] * 3] for _, at_zero, grazing in lobes]
    sigmas = np.array([lobe[0] for lobe in lobes], float)
    return GaussianBrdf(np.full(3, diffuse), sigmas, np.array(weights, float).reshape(-1, 6, 3))


def gonioreflectometer() -> np.ndarray:
    """Angles (rad) of light and viewer: theta, phi, theta, phi."""
    views = np.radians([0, 8, 16, 25, 33, 41, 50, 59, 69, 79])
    turns = np.radians(np.linspace(-175, 180, 18))
    lights = np.radians(np.arange(10, 81, 10))
    return np.array([(light, 0, view, turn) for light in lights for view in views for turn in turns])


def directions(angles: np.ndarray) -> np.ndarray:
    theta, phi = angles.T
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)


def brdf_text(
    brdf: GaussianBrdf, spectrum: np.ndarray | float = 1.0, angles: np.ndarray | None = None
) -> str:
    """`spectrum`: what its grey values are multiplied by at each wavelength."""
    angles = gonioreflectometer() if angles is None else angles
    values = brdf.evaluate(directions(angles[:, :2]), directions(angles[:, 2:]))[:, :1]
    rows = np.hstack([angles, values * (spectrum * np.ones(len(WAVELENGTHS)))])
    head = f"# a made-up paint\n{len(WAVELENGTHS)}\n{' '.join(map(str, WAVELENGTHS))}\n# angles, values\n"
    return head + "\n".join(" ".join(f"{value:.6f}" for value in row) for row in rows) + "\n"


def brdf_file(folder: Path, brdf: GaussianBrdf, spectrum: np.ndarray | float = 1.0) -> Path:
    path = folder / "paint.brdf"
    path.write_text(brdf_text(brdf, spectrum))
    return path
