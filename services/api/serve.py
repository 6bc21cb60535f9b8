"""The REST API's process."""

import socket
from pathlib import Path

import structlog
import uvicorn
from fastapi import FastAPI

from protocol.errors import DeltalightError
from protocol.keys import Keys
from services.api.app import create_app
from services.api.first_scene import make_first_scene
from services.api.settings import ApiSettings
from services.storage.scene_files import import_scene
from services.storage.store import Store, default_folder

FIRST_TOKEN = "first"
MAX_CONNECTIONS = 256
LARGEST_SOCKET_MESSAGE = 1024  # bytes: clients send acknowledgements only

log = structlog.get_logger()


def run_api(settings: ApiSettings, keys: Keys | None = None, scene: Path | None = None) -> None:
    """Serve until SIGINT or SIGTERM; `scene` is imported and rendered first.

    Where there is none at all, the render server's is taken over, or an empty one made. Where the address leaves
    the host and there is no token yet, one is made and printed.

    Raises:
        DeltalightError: the port is in use, the data folder cannot be used, or the scene is wrong.
    """
    with (
        listening(settings.host, settings.port) as listener,
        Store(settings.data or default_folder()) as store,
    ):
        if scene is not None:
            store.scenes.activate(import_scene(store, scene))
        make_first_scene(store, settings, keys)
        if settings.leaves_host:
            _say_who_may_enter(settings, store)
        server = http_server(create_app(settings, store, keys))
        log.info("web process runs", address=f"http://{settings.host}:{settings.port}")
        server.run(sockets=[listener])


class _Server(uvicorn.Server):
    """Ends the live pictures before it waits for connections to end; those would not do so by themselves."""

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop serving."""
        assert isinstance(self.config.app, FastAPI)
        self.config.app.state.context.live.close()
        await super().shutdown(sockets)


def http_server(app: FastAPI) -> uvicorn.Server:
    """The web server that runs the application."""
    config = uvicorn.Config(
        app,
        log_level="warning",
        access_log=False,
        server_header=False,
        proxy_headers=False,  # anybody could send them, and would choose the address that is counted
        limit_concurrency=MAX_CONNECTIONS,
        timeout_graceful_shutdown=1,
        ws_max_size=LARGEST_SOCKET_MESSAGE,
        ws_per_message_deflate=False,  # JPEG does not get smaller
    )
    return _Server(config)


def listening(host: str, port: int) -> socket.socket:
    """A socket that listens at an address.

    Raises:
        DeltalightError: it cannot.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family, backlog=128)
    except OSError as fault:
        raise DeltalightError(
            f"{host} port {port} cannot be listened on ({fault.strerror}); end the program that uses it, or choose "
            "others with --host and --port."
        ) from fault
    # Connections inherit it. asyncio sets it for sockets of its own making only, and without it the body of each
    # answer waits 40 ms for the acknowledgement of its head.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listener


def _say_who_may_enter(settings: ApiSettings, store: Store) -> None:
    log.warning(
        "other hosts can connect; every request needs a token, and nothing is encrypted: put a TLS proxy in front "
        "or use an SSH tunnel",
        host=settings.host,
    )
    if store.tokens.is_empty and settings.token_file is None:
        token = store.tokens.create(FIRST_TOKEN, "control")
        print(f"Token `{FIRST_TOKEN}` (role control), shown this once: {token}", flush=True)
