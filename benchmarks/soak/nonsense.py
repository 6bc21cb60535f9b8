"""A node of nonsense: valid messages, mutated at random."""

import time
from random import Random

from deltalight.protocol.envelope import encode
from deltalight.protocol.messages import ColorMessage, LightsMessage, PoseMessage, StatsMessage
from deltalight.protocol.publisher import Publisher
from deltalight.services import ports

PER_S = 200.0


def send_nonsense(port: int, seconds: float, dice: Random) -> int:
    """Publishes mutated messages at a loopback port for a while; returns how many were sent."""
    publisher = Publisher(ports.endpoint(port))
    known, sent, began_s = known_messages(), 0, time.monotonic()
    try:
        while time.monotonic() < began_s + seconds:
            publisher.send(mutated(dice, dice.choice(known)))
            sent += 1
            time.sleep(max(0.0, began_s + sent / PER_S - time.monotonic()))
    finally:
        publisher.close()
    return sent


def mutated(dice: Random, pieces: list[bytes]) -> list[bytes]:
    """Returns a multipart with bytes changed, inserted, left out, or repeated, but its topic kept: others drop it."""
    pieces = list(pieces)
    for _ in range(dice.randint(1, 4)):
        at = dice.randrange(1, len(pieces))
        piece = bytearray(pieces[at])
        spot = dice.randrange(len(piece) + 1)
        match dice.randrange(4):
            case 0 if piece:
                piece[spot % len(piece)] ^= 1 << dice.randrange(8)
            case 1:
                piece[spot:spot] = dice.randbytes(dice.randint(1, 9))
            case 2:
                del piece[spot : spot + dice.randint(1, 9)]
            case _:
                piece += piece[:spot]
        pieces[at] = bytes(piece)
    return pieces


def known_messages() -> list[list[bytes]]:
    """Returns one message of each of some streams, of a node `stranger`."""
    own: dict[str, object] = {"node": "stranger", "capture_ns": time.time_ns(), "frame_id": 7}
    camera = {"width": 8, "height": 6, "matrix": [8.0, 0.0, 3.5, 0.0, 8.0, 2.5, 0.0, 0.0, 1.0]}
    camera |= {"distortion_model": "plumb_bob", "distortion": [0.0] * 5}
    color = ColorMessage.model_validate({**own, "encoding": "raw", "shape": (6, 8, 3), "camera": camera})
    lights = LightsMessage.model_validate(
        {
            **own,
            "encoding": "raw",
            "size": 4,
            "count": 4,
            "split": "peaks",
            "threshold": 4.0,
            "smoothing_s": 0.5,
            "radiance_frame_id": 1,
            "radiance_capture_ns": 1,
            "world_from_fisheye": [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]],
            "lights": (),
        }
    )
    return [
        encode(color, [bytes(144)]),
        encode(lights, [bytes(192), bytes(64)]),
        encode(PoseMessage.model_validate({**own, "status": "no_board"})),
        encode(StatsMessage.model_validate({**own, "state": "running"})),
    ]
