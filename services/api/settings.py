"""Settings of the REST API's process."""

import re
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated

from pydantic import Field, field_validator

from deltalight.protocol.documents import StrictModel
from deltalight.services.ports import COMPOSITE_PORT, CONTROL_PORT, LOOPBACK, NODE_PORT, PAGE_PORT, endpoint

HOST_NAME = re.compile(
    r"[A-Za-z0-9_]([A-Za-z0-9_-]*[A-Za-z0-9_])?(\.[A-Za-z0-9_]([A-Za-z0-9_-]*[A-Za-z0-9_])?)*\.?"
)


class ApiSettings(StrictModel):
    """Settings of the web process: dashboard, REST API, live video."""

    host: str = Field(
        default=LOOPBACK,
        description="Address to listen on; one that other hosts can reach (0.0.0.0 for all) needs tokens.",
    )
    allowed_hosts: tuple[str, ...] = Field(
        default=(),
        description="Names under which other hosts open the page, such as that of a proxy, beside this host's own "
        "names and IP addresses; requests for any other name are refused. On loopback, only its names are taken.",
    )
    port: int = Field(default=PAGE_PORT, ge=1, le=65535, description="Port to listen on.")
    data: Path | None = Field(
        default=None,
        description="Folder for scenes and assets; null = `deltalight` in the user's data folder.",
    )
    database: str | None = Field(
        default=None,
        description="Address of a PostgreSQL database for scenes, tokens and the facts of assets, such as "
        "postgresql://USER@HOST/NAME; null = the SQLite file in the data folder.",
    )
    assets: str | None = Field(
        default=None,
        description="Address of an object store for asset files, such as s3://BUCKET/FOLDER; the data folder then "
        "caches copies. null = the data folder.",
    )
    jobs: bool = Field(
        default=True,
        description="Whether this process records and replays. If several web processes share one render server, "
        "only one of them may.",
    )
    token_file: Path | None = Field(
        default=None,
        description="File with an additional token of role control, which is never stored: for a secret of the "
        "container engine or systemd.",
    )
    view_token_file: Path | None = Field(
        default=None, description="The same for a token of role view, for example for monitoring."
    )
    control: str = Field(default=endpoint(CONTROL_PORT), description="Control endpoint of the render server.")
    subscribe: tuple[str, ...] = Field(
        default=(endpoint(COMPOSITE_PORT), endpoint(NODE_PORT)),
        description="Endpoints of the render server and the nodes, for pictures and status reports.",
    )
    playback: str | None = Field(
        default=None,
        description="Endpoint that pauses and seeks the recording that the node plays (`replay --control`); null "
        "= the node has a camera.",
    )
    rooms: str | None = Field(
        default=None,
        description="Endpoint of the directory of rooms, which tells where their render servers and nodes are; "
        "null = one room, at `control` and `subscribe`.",
    )
    whep_host: str | None = Field(
        default=None,
        description="Address of this host from which WHEP (WebRTC) viewers receive pictures, on UDP ports that "
        "the system chooses; null = `host`, 0.0.0.0 = all.",
    )
    whep_sessions: int = Field(
        default=16, ge=0, le=192, description="Maximum number of WHEP viewers at a time; 0 disables WHEP."
    )
    upload_limit_mb: int = Field(default=256, ge=1, le=512, description="Maximum size of an upload, MB.")
    recording_limit_mb: int = Field(
        default=4096, ge=1, le=65_536, description="Maximum size of an uploaded recording, MB."
    )
    recording_quota_mb: int = Field(
        default=51_200, ge=1, description="Total size of all recordings beyond which uploads are refused, MB."
    )
    requests_per_s: Annotated[float, Field(ge=1, le=10_000)] = Field(
        default=100.0,
        description="Sustained requests per second from one address; bursts may be twice that, requests with one "
        "token four times.",
    )

    @field_validator("host", "whep_host")
    @classmethod
    def _check_host(cls, host: str | None) -> str | None:
        if host not in (None, "localhost"):
            ip_address(host)  # a name would be resolved, and could change its meaning
        return host

    @field_validator("allowed_hosts")
    @classmethod
    def _check_names(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        for name in names:
            if not HOST_NAME.fullmatch(name):
                raise ValueError(
                    f"{name!r:.80} is not a host name; write it without scheme, port and wildcard."
                )
        return tuple(name.lower().removesuffix(".") for name in names)

    @property
    def leaves_host(self) -> bool:
        """Whether other hosts can connect."""
        return self.host != "localhost" and not ip_address(self.host).is_loopback
