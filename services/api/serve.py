"""The REST API's process: its socket, its web server, and its initial scene."""

import gc
import logging
import socket
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import structlog
import uvicorn
from fastapi import FastAPI

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import write_secret
from deltalight.protocol.keys import Keys
from deltalight.protocol.messages import ControlRequest
from deltalight.protocol.methods import PLUGINS
from deltalight.protocol.request import RequestClient
from deltalight.protocol.scene import SceneDocument, parse_scene
from deltalight.services.api.app import create_app
from deltalight.services.api.connections import HEAD_TIMEOUT_S, LimitedProtocol, RateLimitedLog
from deltalight.services.api.settings import ApiSettings
from deltalight.services.host_store import FIRST_SCENE, activate_first, import_scene
from deltalight.services.storage.data_folder import doing_jobs
from deltalight.services.storage.faults import DatabaseGoneError, StorageFaultError
from deltalight.services.storage.store import Store, default_folder

FIRST_TOKEN, FIRST_TOKEN_FILE = "first", "first_token"
MAX_CONNECTIONS = 256
ANSWER_TIMEOUT_S = 1.0
OTHER_JOBS = (
    "another web process with this data folder records and replays, too: both have the same active scene, and each"
    " page lists the recordings and the replay of both, but ends only its own; name another folder with --data, or"
    " set `jobs = false` in [api] of one of them"
)
DATABASE_PATIENCE_S, DATABASE_INTERVAL_S = 60.0, 2.0
LARGEST_SOCKET_MESSAGE = 1024  # bytes: clients send acknowledgements only

log = structlog.get_logger()


def run_api(settings: ApiSettings, keys: Keys | None = None, scene: Path | None = None) -> None:
    """Serves until SIGINT or SIGTERM; imports and activate `scene` first.

    Without any scene, takes over the render server's, or creates an empty one. If the address leaves the host and
    there is no token yet, creates one and shows it: at a terminal there, else in a file of the data folder.

    Raises:
        DeltalightError: the port is in use, the data folder cannot be used, or the scene is wrong.
    """
    with (
        listening(settings.host, settings.port) as listener,
        open_patiently(settings) as store,
        ExitStack() as held,
    ):
        if settings.jobs and held.enter_context(doing_jobs(store.folder)):
            log.warning(OTHER_JOBS, data=str(store.folder))
        if scene is not None:
            store.scenes.activate(import_scene(store, scene))
        if settings.rooms is None:
            make_first_scene(store, settings, keys)
        if settings.leaves_host:
            _announce_access(settings, store)
        for fault in PLUGINS.faults.values():
            log.warning(fault)
        server = http_server(create_app(settings, store, keys))
        # What lives as long as the process counts no more towards a full collection, which so comes after some
        # viewers have left, not after hundreds (gc: a full one waits until a quarter of all objects are new).
        gc.freeze()
        log.info("web process runs", address=f"http://{settings.host}:{settings.port}")
        server.run(sockets=[listener])


def open_patiently(settings: ApiSettings) -> Store:
    """Opens the service's store; waits for a database that does not answer yet, as when a host starts.

    Raises:
        DeltalightError: it cannot be used.
    """
    ends_s = time.monotonic() + DATABASE_PATIENCE_S
    while True:
        try:
            return Store(
                settings.data or default_folder(), database=settings.database, assets=settings.assets
            )
        except DatabaseGoneError as fault:
            if time.monotonic() >= ends_s:
                raise
            log.warning("waiting for the database", fault=str(fault))
            time.sleep(DATABASE_INTERVAL_S)


class _Server(uvicorn.Server):
    """Ends the live streams, which would not end by themselves, before it waits for connections to close."""

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stops serving."""
        assert isinstance(self.config.app, FastAPI)
        for context in self.config.app.state.contexts.values():
            context.live.close()
        await super().shutdown(sockets)


def http_server(app: FastAPI) -> uvicorn.Server:
    """Returns the web server that runs the application."""
    config = uvicorn.Config(
        app,
        http=LimitedProtocol,
        log_level="warning",
        access_log=False,
        server_header=False,
        proxy_headers=False,  # anybody could send them, and so choose the address that is counted
        limit_concurrency=MAX_CONNECTIONS,
        # Longer than clients keep a connection (httpx: 5 s), which would meet its end with a request.
        timeout_keep_alive=round(HEAD_TIMEOUT_S),
        timeout_graceful_shutdown=1,
        ws_max_size=LARGEST_SOCKET_MESSAGE,
        ws_per_message_deflate=False,  # JPEG does not compress further
    )
    server_log = logging.getLogger("uvicorn.error")
    server_log.filters = [RateLimitedLog()]
    return _Server(config)


def listening(host: str, port: int) -> socket.socket:
    """Returns a socket that listens at an address.

    Raises:
        DeltalightError: it cannot.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family, backlog=128)
    except OSError as fault:
        reason, _, _ = str(fault.strerror).partition(" (while attempting")  # Python names the address again
        raise DeltalightError(
            f"cannot listen on {host} port {port} ({reason}); stop the program that uses it, or choose "
            "others with --host and --port."
        ) from fault
    # Connections inherit it. asyncio sets it only on sockets that it creates, and without it the body of each
    # response waits 40 ms for the acknowledgement of its head.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listener


def _announce_access(settings: ApiSettings, store: Store) -> None:
    log.warning(
        "other hosts can connect; every request needs a token, and nothing is encrypted: put a TLS proxy in front "
        "or use an SSH tunnel",
        host=settings.host,
    )
    if store.tokens.is_empty and settings.token_file is None:
        _hand_out(store.tokens.create(FIRST_TOKEN, "control"), store.folder / FIRST_TOKEN_FILE)


def _hand_out(token: str, path: Path) -> None:
    """Shows the first token to who sits at a terminal; else keep it in a file: what is printed ends in a log."""
    if sys.stdout.isatty():
        print(f"Token `{FIRST_TOKEN}` (role control), shown this once: {token}", flush=True)
        return
    write_secret(path, f"{token}\n".encode())
    log.warning(
        f"token `{FIRST_TOKEN}` (role control) is in a file; delete the file once you have it", file=str(path)
    )


def make_first_scene(store: Store, settings: ApiSettings, keys: Keys | None) -> None:
    """If no scene is active, take over that of the render server, or create an empty one."""
    if store.scenes.active() is not None:
        return
    try:
        shown = _shown_scene(settings.control, keys)
        activate_first(store, shown.replaced(name=shown.name or FIRST_SCENE))
    except StorageFaultError:
        raise
    except (DeltalightError, OSError) as fault:  # it does not run yet, or its files are another host's
        log.debug("nothing to take over from the render server", fault=str(fault))
        activate_first(store, SceneDocument(name=FIRST_SCENE))


def _shown_scene(control: str, keys: Keys | None) -> SceneDocument:
    client = RequestClient(control, keys=keys)
    try:
        reply = client.request(ControlRequest(node="api", id="first-scene", op="get_scene"), ANSWER_TIMEOUT_S)
    finally:
        client.close()
    if reply.error is not None:
        raise DeltalightError(reply.error)
    document = reply.payload.get("scene")
    if not isinstance(document, dict):
        raise DeltalightError("The render server's answer holds no scene.")
    return parse_scene(document)
