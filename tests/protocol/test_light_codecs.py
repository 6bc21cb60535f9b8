"""Messages of light: what was sent comes back, and what cannot be is refused in a sentence."""

from dataclasses import replace

import msgpack
import numpy as np
import pytest

from deltalight.protocol.envelope import MAX_PARTS, EnvelopeError, decode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import FisheyePictures, LampPose, RadianceMap
from deltalight.protocol.light_codecs import fisheye_pictures, lamp_poses, radiance_map, sky_lights
from deltalight.protocol.message_fields import MAX_EXPOSURES, MAX_LIGHTS
from deltalight.protocol.messages import FisheyeMessage, LampsMessage, LightsMessage, RadianceMessage
from deltalight.protocol.scene_lights import LightCut
from deltalight.protocol.sky_lights import Region, SkyLights, TrackedLight
from deltalight.sensor_node.frame_messages import (
    Stamps,
    fisheye_multipart,
    lamps_multipart,
    lights_multipart,
    radiance_multipart,
)
from tests.protocol.fisheye_samples import assert_same_pictures, coded, linear, uncoded_response

NOW = 1_700_000_000_000_000_001
STAMPS = Stamps(node="desk", frame_id=7, capture_ns=NOW, clock_offset_ns=5, clock_bound_ns=None)
JPEG_QUALITY = 95


def placed(*translation: float) -> np.ndarray:
    """A turn about z and a translation."""
    matrix = np.array([[0.6, -0.8, 0, 0], [0.8, 0.6, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    matrix[:3, 3] = translation
    return matrix


def sample_map(size: int = 16, fisheye: FisheyePictures | None = None) -> RadianceMap:
    """A map with a lamp of 5000 in it; smooth picture, so that jpeg keeps it."""
    rng = np.random.default_rng(2)
    seen = rng.random((size, size)) > 0.3
    radiance = np.where(seen[..., None], rng.random((size, size, 3), np.float32), 0).astype(np.float32)
    radiance[3, 4] = 5000.25
    picture = np.repeat(np.arange(0, 240, 6, dtype=np.uint8)[:, None, None], 44, axis=1).repeat(3, axis=2)
    calibration = (fisheye or coded(NOW)).calibration
    return RadianceMap(NOW, radiance, seen, placed(0.25, -0.5, 0.05), 0.015, picture, calibration)


def sample_lights(size: int = 8) -> SkyLights:
    """Two lights, one of which fades, and a residual; of numbers that only their own bits hold."""
    rng = np.random.default_rng(5)
    toward = rng.normal(size=(2, 3))
    lights = tuple(
        TrackedLight(identity, each / np.linalg.norm(each), rng.random(3) * strength, rng.random())
        for identity, each, strength in zip((4, 9), toward, (30.0, 1e-3), strict=True)
    )
    cut = LightCut(count=7, split="all", threshold=1.5, smoothing_s=0.125)
    residual, seen = rng.random((size, size, 3), np.float32), rng.random((size, size, 1), np.float32)
    return SkyLights(cut, placed(0.25, -0.5, 0.05), lights, (Region(0, 3, 2, 5),), residual, seen)


def assert_same_lights(ours: SkyLights, theirs: SkyLights) -> None:
    """Everything is the same to the bit."""
    assert (ours.cut, ours.regions) == (theirs.cut, theirs.regions)
    for one, other in zip(ours.lights, theirs.lights, strict=True):
        assert (one.identity, one.angular_radius_rad) == (other.identity, other.angular_radius_rad)
        assert np.array_equal(one.to_light, other.to_light)
        assert np.array_equal(one.irradiance, other.irradiance)
    for name in ("world_from_fisheye", "residual", "seen"):
        mine, other_array = getattr(ours, name), getattr(theirs, name)
        assert mine.dtype == other_array.dtype
        assert np.array_equal(mine, other_array)


def assert_same_map(ours: RadianceMap, theirs: RadianceMap) -> None:
    """Everything but the picture, which is a jpeg, is the same to the bit."""
    assert (ours.timestamp_ns, ours.clipped_share) == (theirs.timestamp_ns, theirs.clipped_share)
    assert ours.calibration == theirs.calibration
    for mine, other in (
        (ours.radiance, theirs.radiance),
        (ours.seen, theirs.seen),
        (ours.world_from_fisheye, theirs.world_from_fisheye),
    ):
        assert mine.dtype == other.dtype
        assert np.array_equal(mine, other)
    assert np.abs(ours.picture.astype(int) - theirs.picture).max() < 8


def fisheye_message(multipart: list[bytes]) -> tuple[FisheyeMessage, list[memoryview]]:
    message, parts = decode(multipart)
    assert isinstance(message, FisheyeMessage)
    return message, parts


def radiance_message(multipart: list[bytes]) -> tuple[RadianceMessage, list[memoryview]]:
    message, parts = decode(multipart)
    assert isinstance(message, RadianceMessage)
    return message, parts


@pytest.mark.parametrize(
    "pictures",
    [coded(NOW), uncoded_response(coded(NOW, (None,))), linear(NOW), linear(NOW, (0.5, 0.01))],
    ids=["coded bracket", "one coded in sRGB", "one linear", "linear bracket"],
)
def test_raw_pictures_come_back_to_the_bit(pictures: FisheyePictures) -> None:
    message, parts = fisheye_message(fisheye_multipart(pictures, STAMPS, "raw", JPEG_QUALITY))
    assert_same_pictures(fisheye_pictures(message, parts), pictures)
    assert (message.topic, message.frame_id, message.clock_offset_ns) == ("fisheye.desk", 7, 5)


def test_the_largest_bracket_with_a_response_fits_into_a_message() -> None:
    pictures = coded(NOW, tuple(0.001 * 1.5**number for number in range(MAX_EXPOSURES)))
    multipart = fisheye_multipart(pictures, STAMPS, "raw", JPEG_QUALITY)
    assert len(multipart) == MAX_EXPOSURES + 3 <= MAX_PARTS + 2
    assert len(multipart[1]) < 2000, "the response is not in the header"
    assert_same_pictures(fisheye_pictures(*fisheye_message(multipart)), pictures)


def test_jpeg_pictures_come_back_as_codes_of_the_same_size() -> None:
    gradient = sample_map().picture[:36, :40]
    pictures = replace(coded(NOW, (None,)), pictures=(gradient,))
    multipart = fisheye_multipart(pictures, STAMPS, "jpeg", JPEG_QUALITY)
    (picture,) = fisheye_pictures(*fisheye_message(multipart)).pictures
    assert np.abs(picture.astype(int) - gradient).max() < 8
    assert len(multipart[2]) < gradient.nbytes / 2


def test_linear_pictures_are_never_sent_as_jpeg() -> None:
    pictures = linear(NOW)
    message, parts = fisheye_message(fisheye_multipart(pictures, STAMPS, "jpeg", JPEG_QUALITY))
    assert message.encoding == "raw"
    assert_same_pictures(fisheye_pictures(message, parts), pictures)


def test_pictures_that_differ_in_kind_are_not_sent() -> None:
    mixed = replace(coded(NOW), pictures=(*coded(NOW).pictures[:2], linear(NOW).pictures[0]))
    with pytest.raises(EnvelopeError, match="differ in size or kind"):
        fisheye_multipart(mixed, STAMPS, "raw", JPEG_QUALITY)


@pytest.mark.parametrize("fisheye", [coded(NOW), linear(NOW)], ids=["response", "no response"])
def test_a_map_comes_back_to_the_bit(fisheye: FisheyePictures) -> None:
    light = sample_map(fisheye=fisheye)
    message, parts = radiance_message(radiance_multipart(light, STAMPS, JPEG_QUALITY))
    assert_same_map(radiance_map(message, parts), light)
    assert message.has_response == (fisheye.calibration.response is not None)


def test_the_same_camera_is_the_same_object_in_every_message() -> None:
    light = sample_map()
    first, second = (
        radiance_map(*radiance_message(radiance_multipart(light, STAMPS, JPEG_QUALITY))) for _ in range(2)
    )
    pictures = fisheye_pictures(*fisheye_message(fisheye_multipart(coded(NOW), STAMPS, "raw", JPEG_QUALITY)))
    assert first.calibration is second.calibration
    assert first.calibration is pictures.calibration


def lights_message(multipart: list[bytes]) -> tuple[LightsMessage, list[memoryview]]:
    message, parts = decode(multipart)
    assert isinstance(message, LightsMessage)
    return message, parts


def test_lights_come_back_to_the_bit_and_name_their_map() -> None:
    of_map = STAMPS | {"frame_id": 5, "capture_ns": NOW - 70}
    message, parts = lights_message(lights_multipart(sample_lights(), STAMPS, of_map))
    assert_same_lights(sky_lights(message, parts), sample_lights())
    assert (message.frame_id, message.radiance_frame_id, message.radiance_capture_ns) == (7, 5, NOW - 70)


def test_as_many_lights_as_a_message_may_hold_fit_into_it() -> None:
    sky = sample_lights()
    many = replace(sky, lights=sky.lights[:1] * MAX_LIGHTS)
    multipart = lights_multipart(many, STAMPS, STAMPS)
    assert len(multipart[1]) < 20_000
    assert len(sky_lights(*lights_message(multipart)).lights) == MAX_LIGHTS


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"to_light": (1.0, 1.0, 0.0)}, "unit vector"),
        ({"irradiance": (1.0, -1e-9, 0.0)}, "greater than or equal to 0"),
        ({"irradiance": (1.0, float("inf"), 0.0)}, "finite"),
        ({"angular_radius_rad": 2.0}, "less than or equal to 1.6"),
    ],
)
def test_lights_that_cannot_be_are_refused(change: dict[str, object], sentence: str) -> None:
    message, _ = lights_message(lights_multipart(sample_lights(), STAMPS, STAMPS))
    header = message.model_dump()
    header["lights"][1].update(change)
    with pytest.raises(ValueError, match=sentence):
        LightsMessage.model_validate(header)
    for field, wrong in (
        ("size", 48),
        ("count", 17),
        ("threshold", 0.0),
        ("regions", [(3, 3, 0, 1)]),
        ("split", "none"),
        ("lights", [message.lights[0].model_dump()] * (MAX_LIGHTS + 1)),
    ):
        with pytest.raises(ValueError, match=field):
            LightsMessage.model_validate(message.model_dump() | {field: wrong})


def test_residuals_that_cannot_be_are_refused() -> None:
    for change, sentence in (
        ({"residual": np.full((8, 8, 3), -1e-6, np.float32)}, "negative or non-finite"),
        ({"seen": np.full((8, 8, 1), 1.0001, np.float32)}, "between 0 and 1"),
        ({"seen": np.full((8, 8, 1), np.nan, np.float32)}, "between 0 and 1"),
    ):
        wrong = replace(sample_lights(), **change)  # type: ignore[arg-type]
        with pytest.raises(EnvelopeError, match=sentence):
            sky_lights(*lights_message(lights_multipart(wrong, STAMPS, STAMPS)))


def test_lamps_come_back() -> None:
    lamps = (LampPose(40, placed(1, 2, 3)), LampPose(7, placed(-1, 0, 0.5)))
    message, _ = decode(lamps_multipart(lamps, STAMPS))
    assert isinstance(message, LampsMessage)
    back = lamp_poses(message)
    assert [lamp.marker for lamp in back] == [40, 7]
    for ours, theirs in zip(back, lamps, strict=True):
        assert np.array_equal(ours.world_from_marker, theirs.world_from_marker)
    none, _ = decode(lamps_multipart((), STAMPS))
    assert isinstance(none, LampsMessage)
    assert lamp_poses(none) == ()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"radiance": np.full((8, 8, 3), -1, np.float32)}, "negative or non-finite"),
        ({"radiance": np.full((8, 8, 3), np.nan, np.float32)}, "negative or non-finite"),
        ({"seen": np.full((8, 8), 2, np.uint8)}, "other values than 0 and 1"),
    ],
)
def test_maps_that_cannot_be_are_refused(change: dict[str, np.ndarray], message: str) -> None:
    header, parts = radiance_message(radiance_multipart(sample_map(8), STAMPS, JPEG_QUALITY))
    raw = header.model_copy(update={"encoding": "raw"})
    good = [sample_map(8).radiance.tobytes(), sample_map(8).seen.astype(np.uint8).tobytes()]
    for index, name in enumerate(("radiance", "seen")):
        if name in change:
            good[index] = change[name].tobytes()
    with pytest.raises(EnvelopeError, match=message):
        radiance_map(raw, [memoryview(good[0]), memoryview(good[1]), *parts[2:]])


@pytest.mark.filterwarnings("ignore:.*encountered:RuntimeWarning")  # the polynomial overflows
def test_a_camera_that_is_none_is_refused() -> None:
    header, parts = fisheye_message(fisheye_multipart(coded(NOW), STAMPS, "raw", JPEG_QUALITY))
    lens = dict(header.camera["lens"])  # type: ignore[call-overload]
    wild = {"lens": lens | {"distortion": [1e300, -1e300, 1e308, 1e-300]}}
    cameras: tuple[dict[str, object], ...] = (
        {},
        {"lens": {}},
        {"lens": {"distortion_model": "cubic"}},
        wild,
    )
    for camera in cameras:
        with pytest.raises(DeltalightError):
            fisheye_pictures(header.model_copy(update={"camera": camera}), parts)
    with pytest.raises(DeltalightError, match="response"):
        fisheye_pictures(header, [*parts[:-1], memoryview(np.full(768, np.nan, "<f4").tobytes())])


@pytest.mark.filterwarnings("ignore:.*encountered:RuntimeWarning")
def test_mutated_messages_raise_nothing_but_sentences() -> None:
    rng = np.random.default_rng(3)
    multiparts = [
        radiance_multipart(sample_map(), STAMPS, JPEG_QUALITY),
        fisheye_multipart(coded(NOW), STAMPS, "jpeg", JPEG_QUALITY),
        lights_multipart(sample_lights(), STAMPS, STAMPS),
    ]
    refused = 0
    for number in range(1500):
        pieces = [bytearray(piece) for piece in multiparts[number % 3]]
        piece = pieces[rng.integers(1, len(pieces))]
        place = rng.integers(min(len(piece), 64) if rng.random() < 0.5 else len(piece))
        piece[place] = rng.integers(256)
        try:
            message, parts = decode(pieces)
            if isinstance(message, RadianceMessage):
                radiance_map(message, parts)
            elif isinstance(message, FisheyeMessage):
                fisheye_pictures(message, parts)
            elif isinstance(message, LightsMessage):
                sky_lights(message, parts)
        except DeltalightError:
            refused += 1
    assert refused > 100


def test_brackets_that_unpack_to_gigabytes_are_refused_on_both_sides() -> None:
    pixels = np.zeros((4700, 4700, 3), np.uint8)  # 66 MB; as a jpeg less than one
    pictures = replace(coded(NOW, (0.1,) * 5), pictures=(pixels,) * 5)
    with pytest.raises(EnvelopeError, match=r"6 parts unpack to .* fewer or smaller"):
        fisheye_multipart(pictures, STAMPS, "jpeg", JPEG_QUALITY)
    topic, header, *parts = fisheye_multipart(coded(NOW, (None,)), STAMPS, "jpeg", JPEG_QUALITY)
    fields = {**msgpack.unpackb(header), "shape": [4700, 4700, 3], "exposures_s": [0.1] * 5}
    with pytest.raises(EnvelopeError, match="unpack to"):
        decode([topic, msgpack.packb(fields), *parts[:1] * 5, *parts[1:]])
