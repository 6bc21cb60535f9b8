"""Finds the cameras of this host, as the API reports them."""

import threading
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError

from pydantic import BaseModel, Field

from deltalight.services.api.problems import ProblemError

TIMEOUT_S = 10.0  # an SDK that asks the USB bus takes a second


class CameraAnswer(BaseModel):
    """A camera that this host has."""

    name: str
    source: str = Field(description="What opens it, as `node --source` takes it.", examples=["uvc:0"])
    kind: str = Field(examples=["uvc"])
    details: str
    hint: str = Field(description="What keeps it from being opened, and what to do; else empty.")


class MissingCameras(BaseModel):
    """Why no camera of a kind was found."""

    kind: str
    details: str
    hint: str = Field(description="What to do about it.")


class CamerasAnswer(BaseModel):
    """The cameras of this host."""

    cameras: list[CameraAnswer]
    missing: list[MissingCameras] = Field(description="Kinds of which none was found, and why.")


class CameraFinder:
    """Searches for cameras in a thread that may hang; concurrent callers wait for the same search."""

    def __init__(self) -> None:
        self._search: Future[CamerasAnswer] | None = None
        self._lock = threading.Lock()

    def find(self) -> CamerasAnswer:
        """Return the cameras that are attached now.

        Raises:
            ProblemError: the search takes too long.
        """
        with self._lock:
            search = self._search
            if search is None or search.done():
                search = self._search = Future()
                threading.Thread(target=_find, args=(search,), name="cameras", daemon=True).start()
        try:
            return search.result(TIMEOUT_S)
        except FutureTimeoutError:
            sentence = (
                "Looking for cameras takes too long; unplug what hangs, or try `deltalight node --list`."
            )
            raise ProblemError(503, "cameras", sentence) from None


def _find(search: "Future[CamerasAnswer]") -> None:
    from deltalight.sensor_node.cameras.discovery import discover

    try:
        found = discover()
        cameras = [CameraAnswer.model_validate(camera.as_dict()) for camera in found.cameras]
        missing = [MissingCameras(kind=m.kind, details=m.details, hint=m.hint) for m in found.missing]
        search.set_result(CamerasAnswer(cameras=cameras, missing=missing))
    except Exception as fault:  # raised by those who wait
        search.set_exception(fault)
