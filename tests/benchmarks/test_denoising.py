"""The denoised path tracer of `bench quality`: what it needs, and that it helps."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from rich.progress import Progress

from deltalight.benchmarks.ground_truth.render import GuidedPicture, softened
from deltalight.benchmarks.ground_truth.scenes import scene_named
from deltalight.benchmarks.ground_truth.truth import ensure_truth
from deltalight.benchmarks.quality import denoising
from deltalight.benchmarks.quality.case import SceneCase
from deltalight.benchmarks.quality.denoising import Denoiser
from deltalight.benchmarks.quality.path_tracing import trace_in_time
from deltalight.services.cli import run

needs_oidn = pytest.mark.skipif(
    importlib.util.find_spec("oidn") is None, reason="Open Image Denoise is not installed (dev extra)"
)
needs_mitsuba = pytest.mark.skipif(
    importlib.util.find_spec("mitsuba") is None, reason="Mitsuba is not installed (dev extra)"
)


def noisy_edge(size: int = 64) -> tuple[GuidedPicture, np.ndarray]:
    """A bright and a dark half with noise as strong as the light, beyond 1 too; and what it is without noise."""
    clean = np.full((size, size, 3), 0.2, np.float32)
    clean[:, : size // 2] = 3.0
    noise = np.random.default_rng(3).gamma(1.0, 1.0, clean.shape).astype(np.float32)
    normal = np.broadcast_to(np.array([0, 0, 1], np.float32), clean.shape)
    return GuidedPicture(clean * noise, np.full_like(clean, 0.5), normal), clean


def test_without_the_denoiser_the_command_says_so_before_it_measures(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    pytest.importorskip("flip_evaluator")  # the whole command needs the dev extra
    monkeypatch.setattr(denoising, "find_spec", lambda _: None)
    monkeypatch.setattr("deltalight.benchmarks.quality.evaluate.create_context", pytest.fail)
    options = ("--methods", "exact,path+oidn", "--out", str(tmp_path / "quality"))
    assert run(["bench", "quality", *options]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "`path+oidn` needs the package oidn" in line


@needs_oidn
def test_noise_goes_and_bright_light_stays() -> None:
    noisy, clean = noisy_edge()
    denoiser = Denoiser((64, 64))
    found, again = denoiser(noisy), denoiser(noisy)
    denoiser.release()
    assert np.abs(found - clean).mean() < 0.2 * np.abs(noisy.color - clean).mean()
    assert found[:, :24].mean() == pytest.approx(3.0, rel=0.1)
    # On busy cores OIDN's threads round one run in sixty differently, by 1e-5.
    assert again == pytest.approx(found, rel=1e-4)


def test_softening_keeps_light_and_spreads_a_point_by_the_lens() -> None:
    point = np.zeros((9, 9, 3), np.float32)
    point[4, 4] = 1.0
    soft = softened(point)[..., 0]
    assert soft.sum() == pytest.approx(1.0, abs=1e-6)
    variance = float((soft * (np.arange(9) - 4) ** 2).sum())
    assert variance + 1 / 12 == pytest.approx(
        0.5**2, abs=1e-6
    )  # with a pixel's own area: SOFTNESS_PX squared


@needs_oidn
@needs_mitsuba
@pytest.mark.slow
def test_the_denoised_picture_is_nearer_to_the_truth(tmp_path: Path) -> None:
    with Progress(disable=True) as progress:
        truth = ensure_truth(scene_named("cornell"), size=(80, 60), spp=64, progress=progress, cache=tmp_path)
    case = SceneCase.opened(truth)
    plain, denoised = (trace_in_time(case, 1.0, is_denoised=wanted) for wanted in (False, True))
    reference = case.frames[0].sensor_with.astype(float)
    errors = [np.mean((each.pictures[0] - reference) ** 2) for each in (plain, denoised)]
    assert errors[1] < 0.5 * errors[0]
    assert (plain.note, denoised.note) == ("samples a pixel: 4", "samples a pixel: 1")
