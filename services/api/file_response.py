"""A response that sends a file of the data folder, which may be deleted at any moment."""

from fastapi.responses import FileResponse
from starlette.datastructures import Headers
from starlette.types import Message, Receive, Scope, Send

from deltalight.services.api.problems import ProblemError
from deltalight.services.storage.faults import NotFoundError


class StoredFileResponse(FileResponse):
    """A file, or the requested range of it; errors become problem details."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Sends the file.

        Raises:
            NotFoundError: it was deleted meanwhile.
            ProblemError: there is no such range.
        """
        head: Message | None = None

        async def after_reading(message: Message) -> None:
            """Delays the head until the file was read, because the file is opened only after the head is sent."""
            nonlocal head
            if message["type"] == "http.response.start":
                if message["status"] >= 400:
                    raise _no_range(message)
                head = message
                return
            if head is not None:
                await send(head)
                head = None
            await send(message)

        try:
            await super().__call__(_without_foreign_range(scope), receive, after_reading)
        except (RuntimeError, FileNotFoundError) as fault:  # the framework raises the former
            raise NotFoundError("the file was deleted meanwhile; list what there is.") from fault


def _without_foreign_range(scope: Scope) -> Scope:
    """Drops a range that does not count bytes, which is to be ignored (RFC 9110, 14.2)."""
    headers = [
        (name, value)
        for name, value in scope["headers"]
        if name != b"range" or value.strip().lower().startswith(b"bytes=")
    ]
    return {**scope, "headers": headers}


def _no_range(refusal: Message) -> ProblemError:
    size = Headers(raw=refusal["headers"]).get("content-range")
    headers = {} if size is None else {"Content-Range": size}
    return ProblemError(
        refusal["status"], "range", "The file has no such range; ask for bytes that it has.", headers
    )
