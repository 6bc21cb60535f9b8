"""Finds the cameras of this host, as the API reports them."""

import subprocess
import sys
import threading
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError

from pydantic import BaseModel, Field, ValidationError

from deltalight.services.api.problems import ProblemError

TIMEOUT_S = 20.0  # an SDK that asks the USB bus takes a second, and its import another
# In a process of its own: the SDK of the OAK alone takes 131 MB, which no import gives back, and it may hang.
COMMAND = (sys.executable, "-P", "-m", "deltalight.services.cli", "node", "--list", "--json")


class CameraAnswer(BaseModel):
    """A camera that this host has."""

    name: str
    source: str = Field(description="Source that opens it, as for `node --source`.", examples=["uvc:0"])
    kind: str = Field(examples=["uvc"])
    details: str
    hint: str = Field(description="Why it cannot be opened and what to do; else empty.")


class MissingCameras(BaseModel):
    """Why no camera of a kind was found."""

    kind: str
    details: str
    hint: str = Field(description="What to do about it.")


class CamerasAnswer(BaseModel):
    """The cameras of this host."""

    cameras: list[CameraAnswer]
    missing: list[MissingCameras] = Field(description="Kinds of camera that were not found, and why.")


class CameraFinder:
    """Searches for cameras in another process; concurrent callers wait for the same search."""

    def __init__(self) -> None:
        self._search: Future[CamerasAnswer] | None = None
        self._lock = threading.Lock()

    def find(self) -> CamerasAnswer:
        """Returns the cameras that are attached now.

        Raises:
            ProblemError: the search takes too long, or fails.
        """
        with self._lock:
            search = self._search
            if search is None or search.done():
                search = self._search = Future()
                threading.Thread(target=_find, args=(search,), name="cameras", daemon=True).start()
        try:
            return search.result(TIMEOUT_S)
        except (FutureTimeoutError, subprocess.TimeoutExpired):
            raise _failed("Looking for cameras takes too long; unplug the device that hangs") from None
        except (OSError, subprocess.CalledProcessError, ValidationError):
            raise _failed("Looking for cameras ended without an answer; check the log") from None


def _find(search: "Future[CamerasAnswer]") -> None:
    try:
        done = subprocess.run(
            COMMAND, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, timeout=TIMEOUT_S, check=True
        )
        search.set_result(CamerasAnswer.model_validate_json(done.stdout))
    except Exception as fault:  # raised by those who wait
        search.set_exception(fault)


def _failed(sentence: str) -> ProblemError:
    return ProblemError(503, "cameras", f"{sentence}, or try `deltalight node --list`.")
