"""schemathesis over the whole OpenAPI description: no 5xx, and every answer keeps to what is described.

Not covered, because no description holds them: the WebSockets and the endless `live.mjpg`; nor `POST /whep`, whose
SDP schemathesis cannot make. Render server, node and the children that record, replay, look for cameras and make
shelf objects are stand-ins, so that no request waits.
"""

import copy
import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from deltalight.services import ports
from deltalight.services.api import camera_finder, recording_session, replay_control
from deltalight.services.api.problems import Problem
from deltalight.services.storage import assets
from deltalight.services.storage.asset_kinds import Facts
from deltalight.services.storage.asset_sandbox import Task, run_limited
from deltalight.services.storage.shelf import shelf_item
from tests.services.api_samples import RunningApi, running_api
from tests.services.live_samples import StandInStream, wait_for_frames
from tests.services.record_samples import frames, write
from tests.services.render_server_samples import Recorder
from tests.services.storage_samples import TETRAHEDRON, upload

PROBLEM = "application/problem+json"
PROBLEM_SCHEMA = "#/components/schemas/Problem"
CHECKS = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_headers_conformance",
    "response_schema_conformance",
    "missing_required_header",
    "unsupported_method",
    "negative_data_rejection",
)
# Left out, because they ask for what the service does not want:
# positive_data_acceptance: documents name assets and revisions, of which the description cannot say which exist.
# use_after_free, ensure_resource_availability: ids come from dictionaries, so that requests share the resources.
# ignored_auth: on loopback no token is needed; test_api_security.py covers the rest.
OF_EACH = 20  # what there is of each resource; requests delete some
SCENE = {
    "objects": [{"id": "knot", "asset": "t0.obj"}],
    "lights": {"mode": "manual", "manual": [{"type": "sphere", "position_m": [1, 0, 1], "intensity": 5}]},
}


class NoChild:
    """In place of a process that records or replays; it has ended, and nothing was recorded."""

    is_running = False
    last_sentence = ""

    def __init__(self, *_arguments: str, **_callbacks: object) -> None: ...

    def interrupt(self) -> None: ...

    def end(self, _timeout_s: float) -> None: ...

    def wait(self, _timeout_s: float) -> bool:
        return True


def made_here(task: Task, path: Path, name: str, *arguments: str, **limits: int) -> Facts:
    """In place of the limited process, for objects of the shelf."""
    if task != "shelf":
        return run_limited(task, path, name, *arguments, **limits)
    path.write_bytes(shelf_item(arguments[0]).glb())
    return {"triangles": 4}


@pytest.fixture
def full_api(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RunningApi]:
    """With pictures that come, and a render server that answers."""
    for module in (recording_session, replay_control):
        monkeypatch.setattr(module, "ChildProcess", NoChild)
    no_cameras = 'print(\'{"cameras": [], "missing": []}\')'
    monkeypatch.setattr(camera_finder, "COMMAND", (sys.executable, "-S", "-c", no_cameras))
    monkeypatch.setattr(assets, "run_limited", made_here)
    control_port, stream_port = ports.private_ports(2)
    endpoints = {"control": ports.endpoint(control_port), "subscribe": [ports.endpoint(stream_port)]}
    server, stream = Recorder(control_port), StandInStream(stream_port)
    stream.watched = server.watched
    with running_api(tmp_path / "data", requests_per_s=10_000, **endpoints) as running:
        wait_for_frames(f"{ports.LOOPBACK}:{running.client.base_url.port}")
        yield running
    stream.close()
    server.close()


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningApi]:
    with running_api(tmp_path_factory.mktemp("data")) as running:
        upload(running.store, TETRAHEDRON, "t.obj")
        yield running


def fill(api: RunningApi) -> dict[str, Sequence[str | int]]:
    """Puts things of every kind into the store; gives their ids by the parameter that takes them."""
    assets = [upload(api.store, TETRAHEDRON + b"#%d" % n, f"t{n}.obj") for n in range(OF_EACH)]
    scenes = [api.store.scenes.create(SCENE).head.id for _ in range(OF_EACH)]
    api.client.post(f"/scenes/{scenes[0]}/activate").raise_for_status()
    one = {"pictures": [{"name": "a"}]}
    snapshots = [api.client.post("/snapshots", json=one).json()["id"] for _ in range(OF_EACH)]
    recorded = frames(2)
    takes = [write(api.store.folder / "recordings" / f"take{n}.mcap", recorded) for n in range(OF_EACH)]
    return {
        "digest": [asset.reference for asset in assets],
        "scene_id": scenes,
        "object_id": ["knot"],
        "item": ["grey-ball"],
        "index": [0],
        "revision": [1],
        "snapshot_id": snapshots,
        "file": ["a.png"],
        "recording_id": [take.stem for take in takes],
    }


def with_plain_tuples(schema: Any) -> Any:  # noqa: ANN401 - JSON
    """The description with `items` for tuples of one type, whose `prefixItems` schemathesis takes for a fault."""
    if isinstance(schema, list):
        return [with_plain_tuples(each) for each in schema]
    if not isinstance(schema, dict):
        return schema
    plain = {key: with_plain_tuples(value) for key, value in schema.items()}
    first, *others = plain.get("prefixItems", [None])
    if first is not None and all(each == first for each in others):
        plain["items"] = plain.pop("prefixItems")[0]
    return plain


def configuration(known: dict[str, Sequence[str | int]]) -> str:
    """schemathesis.toml: ids that exist in most requests, others in the rest."""
    lines = [f"[dictionaries.{name}]\nvalues = {json.dumps(ids)}" for name, ids in known.items()]
    lines.append("[parameters]")
    lines += [f'"path.{name}" = {{ dictionary = "{name}", probability = 0.8 }}' for name in known]
    return "\n".join(lines)


@pytest.mark.slow(seconds=75)
def test_answers_keep_to_the_description(full_api: RunningApi, tmp_path: Path) -> None:
    description = copy.deepcopy(full_api.app.openapi())  # type: ignore[attr-defined]
    del description["paths"]["/api/v1/whep"]
    (tmp_path / "openapi.json").write_text(json.dumps(with_plain_tuples(description)))
    (tmp_path / "schemathesis.toml").write_text(configuration(fill(full_api)))
    options = ["--checks", ",".join(CHECKS), "--max-examples", "5", "--generation-deterministic"]
    options += ["--request-timeout", "120"]  # of a machine that other tests keep busy
    options += ["--phases", "examples,fuzzing,stateful", "--continue-on-failure", "--no-shrink"]
    address = str(full_api.client.base_url).removesuffix("/api/v1/")
    done = subprocess.run(
        [Path(sys.executable).parent / "schemathesis", "run", "openapi.json", "--url", address, *options],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=700,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "internal" not in full_api.client.get("/state").json()["refused"]


def operations(description: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    return [
        (path, method, operation)
        for path, methods in description["paths"].items()
        for method, operation in methods.items()
    ]


def test_the_description_tells_what_clients_need(api: RunningApi) -> None:
    description = api.app.openapi()  # type: ignore[attr-defined]
    names = [operation["operationId"] for _, _, operation in operations(description)]
    assert len(set(names)) == len(names)
    assert "HTTPValidationError" not in description["components"]["schemas"]
    for _, method, operation in operations(description):
        assert operation["tags"]
        assert operation["summary"]
        content = operation.get("requestBody", {}).get("content", {})
        if content and not content.keys() & {"application/octet-stream", "application/sdp"}:
            body = content["application/json"]
            assert body["schema"].get("examples"), (method, operation["operationId"])
        for status, response in operation["responses"].items():
            assert status < "400" or response["content"] == {PROBLEM: {"schema": {"$ref": PROBLEM_SCHEMA}}}
    assert description["components"]["schemas"]["Problem"]["properties"].keys() == Problem.model_fields.keys()


@pytest.mark.parametrize("part", ["scene", "object", "lights", "method", "real", "output"])
def test_examples_of_the_description_are_accepted(api: RunningApi, part: str) -> None:
    description = api.app.openapi()  # type: ignore[attr-defined]
    by_name = {operation["operationId"]: (path, operation) for path, _, operation in operations(description)}
    path, operation = by_name[{"scene": "create_scene", "object": "create_object"}.get(part, f"put_{part}")]
    scene_id = api.client.post("/scenes", json={}).json()["id"]
    for example in operation["requestBody"]["content"]["application/json"]["schema"]["examples"]:
        text = api.client.build_request("POST", "/", json=example).content.replace(b"knot.glb", b"t.obj")
        method = "POST" if part in ("scene", "object") else "PUT"
        address = path.removeprefix("/api/v1").replace("{scene_id}", scene_id)
        answer = api.client.request(
            method, address, content=text, headers={"Content-Type": "application/json"}
        )
        assert answer.status_code in (200, 201), answer.text
