"""Wrong requests to the REST API of a running station: `python -m tests.fuzz.over_http --minutes 30`.

schemathesis sends negative data to every operation of the OpenAPI description, one request at a time. A fault is an
answer that is 5xx, missing or other than described, and a process that ends.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import urlsplit

import httpx

from deltalight.benchmarks.soak.station import Station
from tests.fuzz.over_sockets import memory_mb, small_station
from tests.services.api_samples import UPLOAD
from tests.services.record_samples import frames, write
from tests.services.storage_samples import TETRAHEDRON
from tests.services.test_api_openapi import CHECKS, SCENE, configuration, with_plain_tuples

SCENES, OTHERS = 20, 5  # what there is of each resource; requests delete some
LOOK_EVERY_S, TELL_EVERY_S = 0.5, 60.0
PATIENCE_S = 120.0  # for one answer, on a machine that does other things as well
LONGEST_PATH = 200
HOOKS = "tests.fuzz.sdp_serializer"

Say = Callable[[str], None]


def main() -> None:
    """Sends them, and prints the figures as a JSON line."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.over_http", description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with small_station(options.seed) as station:
        print(json.dumps(requested(station, options.minutes, options.seed, say)), flush=True)


def say(line: str) -> None:
    """Shows how far it is."""
    print(line, file=sys.stderr, flush=True)


def requested(station: Station, minutes: float, seed: int, say: Say) -> dict[str, Any]:
    """Sends requests for so long; tells what was answered and what became of the processes and their memory (MB)."""
    with TemporaryDirectory(prefix="deltalight-fuzz-") as name:
        folder = Path(name)
        address = str(station.client.base_url).removesuffix("/api/v1/")
        description = httpx.get(f"{address}/openapi.json").raise_for_status().json()
        (folder / "openapi.json").write_text(json.dumps(with_plain_tuples(description)))
        text = f'hooks = "{HOOKS}"\n{configuration(filled(station.client, folder))}'
        (folder / "schemathesis.toml").write_text(text)
        before, began_s = memory_mb(station), time.monotonic()
        with (folder / "told.txt").open("wb") as told:
            running = subprocess.Popen(
                _command(address, minutes, seed),
                cwd=folder,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
                stdout=told,
                stderr=subprocess.STDOUT,
            )
            try:
                peaks = _watched(running, station, before, say)
            finally:
                running.kill()
                running.wait()
        report = folder / "report.json"
        if not report.is_file():
            raise SystemExit(f"schemathesis made no report:\n{(folder / 'told.txt').read_text()[-3000:]}")
        return {
            "seed": seed,
            "seconds": round(time.monotonic() - began_s),
            **_figures(json.loads(report.read_text()), folder / "events.ndjson"),
            "internal_faults": station.client.get("/state").json()["refused"].get("internal", 0),
            "deaths": station.deaths(),
            "memory_mb": {name: (before[name], peaks[name]) for name in before},
        }


def filled(client: httpx.Client, folder: Path) -> dict[str, Sequence[str | int]]:
    """Puts things of every kind into a station; returns their ids by the parameter that takes them."""

    def made(path: str, **body: Any) -> dict[str, Any]:  # noqa: ANN401 - what httpx takes
        return dict(client.post(path, timeout=PATIENCE_S, **body).raise_for_status().json())

    meshes = [TETRAHEDRON + b"#%d" % number for number in range(OTHERS)]
    assets = [
        made(f"/assets?name=t{number}.obj", content=mesh, headers=UPLOAD)["asset"]
        for number, mesh in enumerate(meshes)
    ]
    recording = write(folder / "take.mcap", frames(2)).read_bytes()
    takes = [
        made("/recordings/upload?name=take.mcap", content=recording, headers=UPLOAD)["id"]
        for _ in range(OTHERS)
    ]
    shot = {"pictures": [{"name": "a"}]}
    return {
        "digest": assets,
        "scene_id": [made("/scenes", json=SCENE)["id"] for _ in range(SCENES)],
        "object_id": ["knot"],
        "item": ["grey-ball"],
        "index": [0],
        "revision": [1],
        "snapshot_id": [made("/snapshots", json=shot)["id"] for _ in range(OTHERS)],
        "file": ["a.png"],
        "recording_id": takes,
    }


def _command(address: str, minutes: float, seed: int) -> list[str]:
    return [
        str(Path(sys.executable).parent / "schemathesis"),
        *("run", "openapi.json", "--url", address, "--mode", "negative", "--seed", str(seed)),
        *("--phases", "coverage,fuzzing,stateful", "--checks", ",".join(CHECKS)),
        *("--max-time", str(max(1, round(60 * minutes))), "--rate-limit", "auto"),
        *("--request-timeout", str(PATIENCE_S), "--continue-on-failure", "--no-shrink", "--no-color"),
        *("--report", "json,ndjson"),
        *("--report-json-path", "report.json", "--report-ndjson-path", "events.ndjson"),
    ]


def _watched(
    running: subprocess.Popen[bytes], station: Station, before: dict[str, float], say: Say
) -> dict[str, float]:
    """Returns the peak memory of each process until the requests end."""
    peaks, began_s, tell_s = dict(before), time.monotonic(), 0.0
    while running.poll() is None:
        station.check()
        now_mb, passed_s = memory_mb(station), time.monotonic() - began_s
        peaks |= {name: max(peaks.get(name, 0.0), now) for name, now in now_mb.items()}
        if passed_s >= tell_s:
            tell_s += TELL_EVERY_S
            say(f"{passed_s / 60:.0f} min: memory (MB) {now_mb}, deaths {sum(station.deaths().values())}")
        time.sleep(LOOK_EVERY_S)
    return peaks


def _figures(report: dict[str, Any], events: Path) -> dict[str, Any]:
    """Returns what schemathesis's report and list of events say."""
    statuses, slowest_ms, slowest = Counter[str](), 0.0, ""
    for request, answer in _exchanges(events):
        statuses["none" if answer is None else str(answer["status_code"])] += 1
        if answer is not None and 1e3 * answer["elapsed"] > slowest_ms:
            slowest_ms = 1e3 * answer["elapsed"]
            slowest = f"{request['method']} {urlsplit(request['uri']).path[:LONGEST_PATH]}"
    return {
        "requests": statuses.total(),
        "operations": report["operations"]["tested"],
        "statuses": dict(sorted(statuses.items())),
        "failures": report["failures"],
        "errors": report["errors"],
        "rate_limited": len(report["warnings"]["rate_limited"]),
        "slowest_ms": round(slowest_ms),
        "slowest": slowest,
    }


def _exchanges(events: Path) -> Iterator[tuple[dict[str, Any], dict[str, Any] | None]]:
    """Yields each request with its answer, None if none came."""
    with events.open() as lines:  # hundreds of megabytes
        for line in lines:
            recorder = json.loads(line).get("ScenarioFinished", {}).get("recorder", {})
            for exchange in recorder.get("interactions", {}).values():
                yield exchange["request"], exchange.get("response")


if __name__ == "__main__":
    main()
