"""A REST API for tests: real uvicorn on loopback, a real render session behind a real control socket."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx

from deltalight.protocol.request import ReplyServer
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.server.session import RenderSession
from deltalight.services import ports
from deltalight.services.api.app import create_app
from deltalight.services.api.serve import http_server, listening
from deltalight.services.api.settings import ApiSettings
from deltalight.services.storage.assets import Probe
from deltalight.services.storage.store import Store
from tests.services.render_server_samples import InvertingRenderer
from tests.services.storage_samples import trusting_probe

UPLOAD = {"Content-Type": "application/octet-stream"}


class RenderServer:
    """Answers commands with a render session, as the process does, without OpenGL."""

    def __init__(self, port: int) -> None:
        self.renderer = InvertingRenderer()
        self.session = RenderSession(self.renderer, SceneDocument(name="as started", revision=7))
        self._port = port
        self.open()

    def open(self) -> None:
        """Answers, again too."""
        self._replies = ReplyServer(ports.endpoint(self._port), self._execute)

    def _execute(self, request: object) -> dict[str, object]:
        if getattr(request, "op", "") == "clock":
            return {}
        return self.session.execute(request)  # type: ignore[arg-type]

    def close(self) -> None:
        self._replies.close()


@dataclass(frozen=True)
class RunningApi:
    client: httpx.Client
    store: Store
    control_port: int
    app: object


@contextmanager
def running_api(folder: Path, probe: Probe = trusting_probe, /, **settings: object) -> Iterator[RunningApi]:
    """Serves until the end of the block; `settings` go to `ApiSettings`."""
    port, control_port, stats_port = ports.private_ports(3)
    defaults = {
        "port": port,
        "control": ports.endpoint(control_port),
        "subscribe": [ports.endpoint(stats_port)],
        "requests_per_s": 1000,
    }
    chosen = ApiSettings.model_validate({**defaults, **settings})
    with Store(folder, database=chosen.database, assets=chosen.assets, probe=probe) as store:
        app = create_app(chosen, store)
        server = http_server(app)
        listener = listening(ports.LOOPBACK, port)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        try:
            while not server.started:
                assert thread.is_alive(), "the web process did not start"
                time.sleep(0.01)
            with httpx.Client(base_url=f"http://{ports.LOOPBACK}:{port}/api/v1", timeout=60) as client:
                yield RunningApi(client, store, control_port, app)
        finally:  # its threads would log into the next tests
            server.should_exit = True
            thread.join()
            listener.close()


def sentence(response: httpx.Response, status: int) -> str:
    """The sentence of a problem; checks its form."""
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    problem = response.json()
    assert problem["status"] == status
    assert problem["type"].startswith("urn:deltalight:problem:")
    return str(problem["detail"])
