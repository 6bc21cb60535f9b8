"""`output.camera_artifacts`: objects are as noisy as the camera, and nothing else changes."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.benchmarks.ground_truth.sensors import ColorSensor, srgb_bytes
from deltalight.protocol.frames import decode_lut
from deltalight.protocol.scene_output import Tone
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.post_effects.camera_mosaic import demosaicked
from deltalight.render_server.post_effects.tone import with_tone_curve
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server import test_camera_defocus as lens
from tests.render_server.scenes import COARSE, Stage, ambient, cube, fields_of, floor, frame, look_at, plain

pytestmark = pytest.mark.usefixtures("clean_gl")


@pytest.mark.parametrize("tone", ["camera", "aces"])
def test_objects_get_the_cameras_noise(gpu: GpuContext, tmp_path: Path, tone: Tone) -> None:
    """From the second still frame on; pixels without objects are those of the picture without it, to the bit."""
    sensor, rng = ColorSensor(3e-4, 0.01), np.random.default_rng(1)
    clean = decode_lut(None)[plain(150), np.arange(3)] * np.linspace(0.2, 1, plain().shape[1])[None, :, None]
    frames = [
        frame(sensor.expose(clean.astype(np.float32), rng), frame_id=number, timestamp_ns=number)
        for number in range(2)
    ]
    stage = Stage(tmp_path, COARSE)
    document = stage.document([stage.virtual(cube(0.3))], [ambient(0.5)], floor())
    document = document.replaced(output=document.output.replaced(tone=tone))
    noisy = document.replaced(output=document.output.replaced(camera_artifacts=True))
    pictures = {}
    for name, scene in (("off", document), ("on", noisy)):
        renderer = SceneRenderer(gpu, scene)
        pictures[name] = [renderer.render(each).color for each in (*frames, frames[1])]
        covered = fields_of(renderer).matte > 0.99
        inside = fields_of(renderer).matte > 0
        renderer.release()
    (first, second, _), (plain_first, plain_second, _) = pictures["on"], pictures["off"]
    assert np.array_equal(first, plain_first)
    assert np.array_equal(second[~inside], plain_second[~inside])
    assert np.array_equal(pictures["on"][1], pictures["on"][2])
    lut = decode_lut(with_tone_curve(frames[0], tone).response)
    before, after = (lut[each, np.arange(3)][covered] for each in (plain_second, second))
    expected = np.mean(0.01**2 + 3e-4 * before)
    assert np.mean((after - before) ** 2) == pytest.approx(expected, rel=0.2)


def test_objects_are_smeared_as_the_camera_moves(gpu: GpuContext, tmp_path: Path) -> None:
    """By the pose's way in the exposure; what the smeared object does not reach stays as it was, to the bit."""
    still, moved = look_at(), look_at()
    moved.world_from_camera[:3, 3] += 0.1 * moved.world_from_camera[:3, 0]
    frames = [
        frame(pose=pose, frame_id=number, timestamp_ns=number * 20_000_000, exposure_s=0.01)
        for number, pose in enumerate((still, moved))
    ]
    stage = Stage(tmp_path, COARSE)
    document = stage.document([stage.virtual(cube(0.3))], [ambient(0.5)], floor())
    pictures = {}
    for name, asked in (("off", False), ("on", True)):
        scene = document.replaced(output=document.output.replaced(camera_artifacts=asked))
        renderer = SceneRenderer(gpu, scene)
        pictures[name] = [renderer.render(each).color.astype(int) for each in frames]
        covered = fields_of(renderer).matte > 0
        renderer.release()
    (first, second), (plain_first, plain_second) = pictures["on"], pictures["off"]
    assert np.array_equal(first, plain_first)
    changed = (second != plain_second).any(axis=2)
    rows, columns = np.nonzero(covered)
    reached = np.nonzero(changed)
    assert reached[1].min() < columns.min()
    assert reached[1].max() > columns.max()
    assert abs(reached[0].min() - rows.min()) <= 1
    assert abs(reached[0].max() - rows.max()) <= 1


def test_objects_are_compressed_as_the_picture_is(gpu: GpuContext, tmp_path: Path) -> None:
    """From the first frame on; pixels without objects are those of the picture without it, to the bit."""
    rows, columns = np.mgrid[: plain().shape[0], : plain().shape[1]]
    clean = decode_lut(None)[plain(150), np.arange(3)] * (1 + 0.3 * np.sin(columns / 4 + rows / 9))[..., None]
    noisy = ColorSensor(3e-4, 0.01).expose(clean.astype(np.float32), np.random.default_rng(1))
    _, code = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, 40])
    seen = frame(np.asarray(cv2.imdecode(code, cv2.IMREAD_COLOR), np.uint8))
    stage = Stage(tmp_path, COARSE)
    document = stage.document([stage.virtual(cube(0.3))], [ambient(0.5)], floor())
    pictures = {}
    for asked in (False, True):
        renderer = SceneRenderer(
            gpu, document.replaced(output=document.output.replaced(camera_artifacts=asked))
        )
        pictures[asked] = renderer.render(seen).color
        covered = fields_of(renderer).matte > 0
        renderer.release()
    without, with_it = pictures[False], pictures[True]
    assert np.array_equal(with_it[~covered], without[~covered])
    assert (with_it[covered] != without[covered]).any()


def sharpness(picture: np.ndarray, where: np.ndarray) -> float:
    """Sum of squared steps from pixel to pixel, in linear light, in and around an object."""
    light = decode_lut(None)[picture[..., 1], 1].astype(float)
    around = cv2.dilate(where.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return float(((np.diff(light, axis=1) ** 2)[around[:, 1:]]).sum())


@pytest.mark.parametrize("antialiasing", [False, True])
def test_objects_out_of_focus_are_soft(gpu: GpuContext, tmp_path: Path, antialiasing: bool) -> None:
    """From the first frame that sees the board obliquely on: a near cube loses more than one in focus does."""
    seen = lens.shot(lens.oblique(55.0))
    stage = Stage(tmp_path, COARSE)
    cubes = [
        stage.virtual(cube(0.035, (x, y, 0.0)), (0.02,) * 3) for x, y in ((0.06, -0.26), (0.095, -0.145))
    ]
    document = stage.document(cubes, [ambient(0.5)], floor())
    pictures = {}
    for asked in (False, True):
        output = document.output.replaced(camera_artifacts=asked, antialiasing=antialiasing)
        renderer = SceneRenderer(gpu, document.replaced(output=output))
        pictures[asked] = [renderer.render(seen).color for _ in range(2)]
        covered = fields_of(renderer).matte > 0
        renderer.release()
    (without, _), (with_it, again) = pictures[False], pictures[True]
    assert np.array_equal(with_it, again)
    far_off = cv2.dilate(covered.astype(np.uint8), np.ones((41, 41), np.uint8)) == 0
    assert far_off.any()
    assert np.array_equal(with_it[far_off], without[far_off])
    count, labels = cv2.connectedComponents(covered.astype(np.uint8))
    assert count == 3
    focused, near = (sharpness(with_it, labels == n) / sharpness(without, labels == n) for n in (1, 2))
    assert near < 0.6 * focused


def test_objects_are_seen_through_the_cameras_mosaic(gpu: GpuContext, tmp_path: Path) -> None:
    """From the first frame on a grey object's edges have coloured fringes, and what is beside them stays."""
    light = decode_lut(None)[plain(150), np.arange(3)] + np.random.default_rng(2).normal(
        0, 0.01, (120, 160, 3)
    )
    seen = frame(srgb_bytes(demosaicked(light.astype(np.float32), "GRBG")))
    stage = Stage(tmp_path, COARSE)
    document = stage.document([stage.virtual(cube(0.3), (0.02,) * 3)], [ambient(0.5)], floor())
    pictures = {}
    for asked in (False, True):
        renderer = SceneRenderer(
            gpu, document.replaced(output=document.output.replaced(camera_artifacts=asked))
        )
        pictures[asked] = renderer.render(seen).color.astype(int)
        covered = fields_of(renderer).matte > 0
        renderer.release()
    beside = cv2.dilate(covered.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert np.array_equal(pictures[True][~beside], pictures[False][~beside])
    edge = beside & ~(cv2.erode(covered.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    fringes = [np.abs(each[edge][:, ::2] - each[edge][:, 1:2]).mean() for each in pictures.values()]
    assert fringes[1] > 3 * fringes[0]


def test_a_glowing_object_has_bloom_in_every_composite(gpu: GpuContext, tmp_path: Path) -> None:
    stage = Stage(tmp_path, COARSE)
    lamp = stage.virtual(cube(0.1)) | {"material": {"base_color": [0, 0, 0], "emission": [2, 2, 2]}}
    document = stage.document([lamp], [ambient(0.5)], floor())
    pictures = []
    for bloom in (0.0, 0.1):
        scene = document.replaced(output=document.output.replaced(bloom=bloom))
        renderer = SceneRenderer(gpu, scene)
        first = renderer.submit(frame(), others=("delta", "composite")).finish()
        pictures.append(first.color.astype(int))
        assert np.array_equal(first.others[1].color, first.color)
        covered = fields_of(renderer).matte > 0
        renderer.release()
    plain_picture, glowing = pictures
    rows, columns = np.nonzero(covered)
    beside = np.s_[rows.min() : rows.max(), columns.max() + 2]
    assert (glowing[beside] - plain_picture[beside]).mean() > 1
