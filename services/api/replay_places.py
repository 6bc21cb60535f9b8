"""Where a replay publishes and is controlled, so that the render server reaches it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

from protocol.endpoints import parse_endpoint
from services import ports
from services.storage.faults import ConflictError

IPC = "ipc://"


@dataclass(frozen=True)
class ReplayPlaces:
    """The endpoints of one replay."""

    streams: str
    control: str

    @classmethod
    def beside(cls, server: str) -> Self:
        """Sockets in the folder of the render server's own, which may be another container's; else loopback ports.

        The sockets' names are always the same: a replay takes over what a killed service left.

        Args:
            server: endpoint of the render server's commands.

        Raises:
            ConflictError: the render server is on another host.
        """
        if server.startswith(IPC):
            return cls(f"{server}-replay", f"{server}-replay-control")
        if parse_endpoint(server).leaves_host:
            raise ConflictError(
                "the render server is on another host and cannot read a replay of this one; run"
                " `deltalight replay` there."
            )
        streams, control = ports.private_ports(2)
        return cls(ports.endpoint(streams), ports.endpoint(control))

    def clear(self) -> None:
        """Remove what closed sockets leave in their folder."""
        for endpoint in (self.streams, self.control):
            if endpoint.startswith(IPC):
                Path(endpoint.removeprefix(IPC)).unlink(missing_ok=True)
