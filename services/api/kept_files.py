"""Answers that are a file of the data folder, which somebody else may delete at any moment."""

from fastapi.responses import FileResponse
from starlette.datastructures import Headers
from starlette.types import Message, Receive, Scope, Send

from services.api.problems import ProblemError
from services.storage.faults import NotFoundError


class KeptFile(FileResponse):
    """A file, or the range of it that is asked for; what keeps it from being sent is a problem as elsewhere."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it.

        Raises:
            NotFoundError: it was deleted meanwhile.
            ProblemError: there is no such range.
        """
        head: Message | None = None

        async def after_reading(message: Message) -> None:
            """Keep the head back until something was read: the file is opened after it is sent."""
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
            await super().__call__(scope, receive, after_reading)
        except (RuntimeError, FileNotFoundError) as fault:  # the former is the framework's word for it
            raise NotFoundError("the file was deleted meanwhile; list what there is.") from fault


def _no_range(refusal: Message) -> ProblemError:
    size = Headers(raw=refusal["headers"]).get("content-range")
    headers = {} if size is None else {"Content-Range": size}
    return ProblemError(
        refusal["status"], "range", "The file has no such range; ask for bytes that it has.", headers
    )
