"""A typed client of the REST API: scenes, assets, live pictures, snapshots, recordings (docs/python-client.md).

with Client("http://127.0.0.1:8000") as client:
    scene = client.active_scene()
    scene.move("knot", translation_m=(0.3, -0.1, 0.0))
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, cast
from urllib.parse import quote, urlencode

import httpx
import numpy as np
from jaxtyping import UInt8

from deltalight.protocol.codecs import decode_color
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import replacing, write_bytes
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_fields import ShownView
from deltalight.services.live_message import LiveHeader, unpack

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

Json = dict[str, Any]
Place = tuple[float, float, float]
Rotation = tuple[float, float, float, float]


class ApiError(DeltalightError):
    """A request that the service refused: `kind` ends the problem's type, such as `stale-revision`."""

    def __init__(self, sentence: str, status: int, kind: str, revision: int | None = None) -> None:
        super().__init__(sentence)
        self.status = status
        self.kind = kind
        self.revision = revision


@dataclass(frozen=True)
class Asset:
    """An uploaded file; `reference` is its name in scene documents, `facts` hold size and bounds."""

    reference: str
    names: tuple[str, ...]
    kind: str
    size_bytes: int
    facts: Mapping[str, Any]

    @classmethod
    def of(cls, answer: Json) -> Self:
        """Creates it from a response of the service."""
        names = tuple(answer["names"])
        return cls(answer["asset"], names, answer["kind"], answer["size_bytes"], answer["facts"])


@dataclass(frozen=True)
class LiveFrame:
    """A received composite; `header` holds its pass times, lights, camera and pose."""

    header: LiveHeader
    jpeg: bytes

    @property
    def frame_id(self) -> int:
        """The camera's frame."""
        return self.header.frame_id

    @property
    def age_ms(self) -> float:
        """Time from its capture to its sending."""
        return self.header.age_ms

    @property
    def scene_id(self) -> str | None:
        """The scene that it shows; None if another program set it."""
        return None if self.header.scene is None else self.header.scene.id

    @property
    def scene_revision(self) -> int | None:
        """The revision of that scene."""
        return None if self.header.scene is None else self.header.scene.revision

    def picture(self) -> UInt8[np.ndarray, "h w 3"]:
        """Decodes the picture: RGB, camera-coded."""
        camera = self.header.camera
        return decode_color(memoryview(self.jpeg), "jpeg", (camera.height, camera.width, 3))


class Scene:
    """A scene at the last known revision. Each change is one request, and one revision.

    A change applies to the newest revision, whoever made it; inside `exclusively()` it is refused with an `ApiError`
    of kind `stale-revision` if somebody else made a change in between.
    """

    def __init__(self, client: "Client", answer: Json) -> None:
        self._client = client
        self._answer = answer
        self._guarded = False

    @property
    def id(self) -> str:
        """Name in addresses."""
        return str(self._answer["id"])

    @property
    def revision(self) -> int:
        """The revision of `document`."""
        return int(self._answer["revision"])

    @property
    def document(self) -> SceneDocument:
        """The scene document as last known."""
        return SceneDocument.model_validate(self._answer["document"])

    @property
    def picture(self) -> tuple[str, str] | None:
        """What the render server did with it: `shown`, `pending` or `refused`, and why; None unless it is active."""
        picture = self._answer["picture"]
        return None if picture is None else (picture["state"], picture["detail"])

    def refresh(self) -> None:
        """Loads the newest revision."""
        self._take(self._client.request("GET", self._path()))

    @contextmanager
    def exclusively(self) -> Iterator[None]:
        """Refuses changes to a revision that is no longer the newest."""
        self._guarded = True
        try:
            yield
        finally:
            self._guarded = False

    def replace(self, document: SceneDocument) -> None:
        """Replaces the document."""
        body = document.model_dump(mode="json", exclude={"revision"})
        self._change("PUT", "", body)

    def add_object(self, asset: Asset | str, **keys: Any) -> str:  # noqa: ANN401 - keys of the scene document
        """Adds an object with keys of the scene document (`pose`, `material`, ...); returns its id."""
        reference = asset.reference if isinstance(asset, Asset) else asset
        before = {item["id"] for item in self._answer["document"]["objects"]}
        self._change("POST", "/objects", {"asset": reference, **keys})
        ids = [str(item["id"]) for item in self._answer["document"]["objects"]]
        return next((each for each in reversed(ids) if each not in before), ids[-1])

    def change_object(self, object_id: str, **keys: Any) -> None:  # noqa: ANN401 - keys of the scene document
        """Changes keys of an object; the others stay."""
        self._change("PATCH", _object_path(object_id), keys)

    def move(
        self, object_id: str, *, translation_m: Place | None = None, rotation_wxyz: Rotation | None = None
    ) -> None:
        """Changes the position, metres, and rotation of an object."""
        pose = {"translation_m": translation_m, "rotation_wxyz": rotation_wxyz}
        self.change_object(object_id, pose={key: value for key, value in pose.items() if value is not None})

    def remove_object(self, object_id: str) -> None:
        """Removes an object."""
        self._change("DELETE", _object_path(object_id), None)

    def set_lights(self, **keys: Any) -> None:  # noqa: ANN401 - keys of the scene document
        """Changes keys of the lights (`mode`, `manual`, `environment`, ...)."""
        self._change("PATCH", "/lights", keys)

    def set_method(self, name: str, **settings: Any) -> None:  # noqa: ANN401 - settings of the method
        """Relights with another method, with these settings and defaults for the others."""
        self._change("PUT", "/method", {"name": name, **settings})

    def set_output(self, **keys: Any) -> None:  # noqa: ANN401 - keys of the scene document
        """Changes keys of the output (`view`, `antialiasing`, ...)."""
        self._change("PATCH", "/output", keys)

    def undo(self) -> None:
        """Undoes the last change."""
        self._change("POST", "/undo", None)

    def redo(self) -> None:
        """Redoes the change that was undone."""
        self._change("POST", "/redo", None)

    def activate(self) -> None:
        """Shows this scene."""
        self._change("POST", "/activate", None)

    def delete(self) -> None:
        """Deletes the scene, unless it is active."""
        self._client.request("DELETE", self._path())

    def _path(self, rest: str = "") -> str:
        return f"/scenes/{self.id}{rest}"

    def _change(self, method: str, rest: str, body: Json | None) -> None:
        headers = {"If-Match": f'"{self.revision}"'} if self._guarded else {}
        self._take(self._client.request(method, self._path(rest), json=body, headers=headers))

    def _take(self, answer: Any) -> None:  # noqa: ANN401 - JSON
        self._answer = answer


def _object_path(object_id: str) -> str:
    """Where an object is in its scene; ids may hold any character, such as `?`."""
    return f"/objects/{quote(object_id, safe='')}"


class Client:
    """Connects to one service. Errors are `ApiError`; a service that does not answer is a `DeltalightError`.

    Raises:
        DeltalightError: the address is malformed.
    """

    def __init__(self, address: str, token: str | None = None, *, timeout_s: float = 60.0) -> None:
        self._address = address.rstrip("/")
        self._headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        try:
            self._http = httpx.Client(
                base_url=self._address + "/api/v1", headers=self._headers, timeout=timeout_s
            )
        except httpx.InvalidURL as fault:
            raise DeltalightError(
                f"{address!r} is not an address ({fault}); use http://HOST:PORT."
            ) from fault

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connections."""
        self._http.close()

    def scenes(self) -> list[Json]:
        """Returns id, name, revision and times of all scenes."""
        return cast(list[Json], self.request("GET", "/scenes"))

    def scene(self, scene_id: str) -> Scene:
        """Returns the scene with this id."""
        return Scene(self, self.request("GET", f"/scenes/{scene_id}"))

    def active_scene(self) -> Scene:
        """Returns the scene that is rendered."""
        return Scene(self, self.request("GET", "/active-scene"))

    def create_scene(self, document: SceneDocument | Mapping[str, Any]) -> Scene:
        """Creates a scene; it is shown once activated."""
        body = document.model_dump(mode="json") if isinstance(document, SceneDocument) else dict(document)
        return Scene(self, self.request("POST", "/scenes", json=body))

    def assets(self) -> list[Asset]:
        """Returns all uploaded files, the newest first."""
        return [Asset.of(answer) for answer in self.request("GET", "/assets")]

    def upload(self, path: Path) -> Asset:
        """Uploads a mesh or an environment map."""
        return Asset.of(self._upload("/assets", path))

    def upload_recording(self, path: Path) -> Json:
        """Uploads an .mcap recording, or a .zip of a dataset folder; returns its facts, with a checklist."""
        return cast(Json, self._upload("/recordings/upload", path))

    def _upload(self, address: str, path: Path) -> Any:  # noqa: ANN401 - JSON
        headers = {"Content-Type": "application/octet-stream"}
        try:
            with path.open("rb") as file:
                return self.request(
                    "POST", address, params={"name": path.name}, content=file, headers=headers, timeout=None
                )
        except OSError as fault:
            raise DeltalightError(f"{path} cannot be read ({fault.strerror}); correct the path.") from fault

    def state(self) -> Json:
        """Returns rates, drops and delays of the processes."""
        return cast(Json, self.request("GET", "/state"))

    def cameras(self) -> list[str]:
        """Returns the names of the cameras whose pictures are made, the first one's first."""
        return [str(each["name"]) for each in self.state()["cameras"]]

    def pick(self, x: float, y: float, *, ignore: str | None = None, camera: str | None = None) -> Json:
        """Returns what a pixel of a camera's newest picture shows, looking through the object `ignore`.

        `camera`: None = the first one.
        """
        body = {"x": x, "y": y, "ignore": ignore, "camera": camera}
        return cast(Json, self.request("POST", "/live/pick", json=body))

    def snapshot(
        self,
        folder: Path,
        pictures: Sequence[Mapping[str, Any]] | None = None,
        *,
        exr: bool = False,
        camera: str | None = None,
    ) -> list[Path]:
        """Renders one frame in several ways, `{name, view, method?}` each, and saves the pictures in `folder`.

        `camera`: whose frame; None = the first one's.

        Raises:
            ApiError: no picture could be rendered.
            DeltalightError: a picture cannot be written, or the service does not answer.
        """
        body: Json = {"exr": exr} | ({} if camera is None else {"camera": camera})
        if pictures is not None:
            body["pictures"] = [dict(each) for each in pictures]
        made = self.request("POST", "/snapshots", json=body)
        folder.mkdir(parents=True, exist_ok=True)
        files = []
        for name in made["files"]:
            files.append(folder / name)
            write_bytes(files[-1], self._sent("GET", f"/snapshots/{made['id']}/{name}").content)
        return files

    def start_recording(self, name: str | None = None, duration_s: float | None = None) -> Json:
        """Records the node's streams, until stopped or for this time."""
        body = {"name": name, "duration_s": duration_s}
        body = {key: value for key, value in body.items() if value is not None}
        return cast(Json, self.request("POST", "/recordings", json=body))

    def stop_recording(self, recording_id: str) -> Json:
        """Stops a recording; returns its facts."""
        return cast(Json, self.request("POST", f"/recordings/{recording_id}/stop"))

    def download_recording(self, recording_id: str, path: Path) -> None:
        """Saves a recording as an .mcap file, atomically.

        Raises:
            ApiError: there is none, or it is still growing.
            DeltalightError: the file cannot be written, or the service does not answer.
        """
        address = f"/recordings/{recording_id}/content"
        with replacing(path) as temporary, self._reaching(), self._http.stream("GET", address) as response:
            if response.is_error:
                response.read()
                raise _refusal(response)
            with temporary.open("wb") as file:
                for chunk in response.iter_bytes():
                    file.write(chunk)

    def frames(self, view: ShownView | None = None, *, camera: str | None = None) -> Iterator[LiveFrame]:
        """Yields composites as they arrive, always the newest; a slow caller misses some.

        `view`: what to look at; None = the scene's own. Until the renderer shows it, frames are in the scene's own
        (`frame.header.view`). `camera`: whose pictures, by its node's name; None = the first one's.
        """
        wanted = {"view": view, "camera": camera}
        query = urlencode({key: value for key, value in wanted.items() if value is not None})
        with self._socket(f"/live?{query}" if query else "/live") as socket:
            for message in socket:
                if isinstance(message, bytes):
                    yield LiveFrame(*unpack(message))
                    socket.send("ack")

    def events(self) -> Iterator[Json]:
        """Yields events as they arrive: `{type, ...}`; the first is `hello`."""
        with self._socket("/events") as socket:
            for message in socket:
                yield json.loads(message)

    def request(self, method: str, path: str, **options: Any) -> Any:  # noqa: ANN401 - JSON
        """Sends one request and returns the response's JSON; for routes without a method here.

        Raises:
            ApiError: the service refused it.
            DeltalightError: the service does not answer.
        """
        response = self._sent(method, path, **options)
        try:
            return response.json() if response.content else None
        except ValueError as fault:
            raise DeltalightError(
                f"What answers at {self._address} is not a Deltalight service; correct the address."
            ) from fault

    def _sent(self, method: str, path: str, **options: Any) -> httpx.Response:  # noqa: ANN401 - as httpx takes them
        with self._reaching():
            response = self._http.request(method, path, **options)
        if response.is_error:
            raise _refusal(response)
        return response

    @contextmanager
    def _reaching(self) -> Iterator[None]:
        try:
            yield
        except httpx.RequestError as fault:
            raise DeltalightError(
                f"No service answers at {self._address} ({fault}); start it, or correct the address."
            ) from fault

    @contextmanager
    def _socket(self, path: str) -> Iterator["ClientConnection"]:
        """Opens a WebSocket, with a ticket if the service requires tokens."""
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect

        mark = "&" if "?" in path else "?"
        query = f"{mark}ticket={self.request('POST', '/tickets')['ticket']}" if self._headers else ""
        address = f"ws{self._address.removeprefix('http')}/api/v1{path}{query}"
        try:
            with connect(address, max_size=None, compression=None) as socket:
                yield socket
        except (OSError, WebSocketException) as fault:
            raise DeltalightError(
                f"The stream {path} of {self._address} ended ({fault}); check that the service is running."
            ) from fault


def _refusal(response: httpx.Response) -> ApiError:
    try:
        problem = response.json()
        kind = str(problem["type"]).rsplit(":", 1)[-1]
        return ApiError(problem["detail"], response.status_code, kind, problem.get("revision"))
    except (ValueError, KeyError, TypeError):
        sentence = f"The service answered {response.status_code} without a reason; see its log."
        return ApiError(sentence, response.status_code, "unknown")
