"""Settings of the REST API's process."""

from ipaddress import ip_address
from pathlib import Path
from typing import Annotated

from pydantic import Field, field_validator

from deltalight.protocol.documents import StrictModel
from deltalight.services.ports import COMPOSITE_PORT, CONTROL_PORT, LOOPBACK, NODE_PORT, PAGE_PORT, endpoint


class ApiSettings(StrictModel):
    """Settings of the web process: dashboard, REST API, live video."""

    host: str = Field(
        default=LOOPBACK,
        description="Address to listen on; one that other hosts can reach (0.0.0.0 for all) needs tokens.",
    )
    port: int = Field(default=PAGE_PORT, ge=1, le=65535, description="Port to listen on.")
    data: Path | None = Field(
        default=None,
        description="Folder of scenes and assets; null = `deltalight` in the user's data folder.",
    )
    database: str | None = Field(
        default=None,
        description="Address of a PostgreSQL database for scenes, tokens and what is known of assets, such as "
        "postgresql://USER@HOST/NAME; null = the SQLite file in the data folder.",
    )
    assets: str | None = Field(
        default=None,
        description="Address of a store for the files of assets, such as s3://BUCKET/FOLDER; the data folder then "
        "holds copies. null = the data folder.",
    )
    jobs: bool = Field(
        default=True,
        description="Whether this process records and replays. Of several web processes for one render server, all "
        "but one do not.",
    )
    token_file: Path | None = Field(
        default=None,
        description="File with one more token, of role control, which is never stored: a secret of the container "
        "engine or of systemd.",
    )
    view_token_file: Path | None = Field(
        default=None, description="The same for a token of role view, such as that of a monitor."
    )
    control: str = Field(
        default=endpoint(CONTROL_PORT), description="Endpoint of the render server's commands."
    )
    subscribe: tuple[str, ...] = Field(
        default=(endpoint(COMPOSITE_PORT), endpoint(NODE_PORT)),
        description="Endpoints of the render server and of the nodes: pictures, and how they are doing.",
    )
    playback: str | None = Field(
        default=None,
        description="Endpoint at which the recording that the node plays (`replay --control`) is paused and moved "
        "along; null = the node has a camera.",
    )
    rooms: str | None = Field(
        default=None,
        description="Endpoint of the directory of rooms, which says where their render servers and nodes are; null = "
        "one room, at `control` and `subscribe`.",
    )
    whep_host: str | None = Field(
        default=None,
        description="Address of this host at which viewers by WHEP (WebRTC) are sent pictures, on UDP ports that the "
        "system chooses; null = `host`. 0.0.0.0 = all.",
    )
    whep_sessions: int = Field(
        default=16, ge=0, le=192, description="Viewers by WHEP at a time; 0 switches it off."
    )
    upload_limit_mb: int = Field(default=256, ge=1, le=512, description="Greatest size of an upload, MB.")
    recording_limit_mb: int = Field(
        default=4096, ge=1, le=65_536, description="Greatest size of an uploaded recording, MB."
    )
    recording_quota_mb: int = Field(
        default=51_200, ge=1, description="What all recordings may take before uploads are refused, MB."
    )
    requests_per_s: Annotated[float, Field(ge=1, le=10_000)] = Field(
        default=100.0,
        description="Requests a second that one client may send for long; twice as many at once.",
    )

    @field_validator("host", "whep_host")
    @classmethod
    def _check_host(cls, host: str | None) -> str | None:
        if host not in (None, "localhost"):
            ip_address(host)  # a name would be resolved, and could change its meaning
        return host

    @property
    def leaves_host(self) -> bool:
        """Whether other hosts can connect."""
        return self.host != "localhost" and not ip_address(self.host).is_loopback
