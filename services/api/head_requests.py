"""HEAD where there is GET (RFC 9110, 9.3.2): routes of the framework only know the methods that they are given."""

import asyncio

from starlette.types import ASGIApp, Message, Receive, Scope, Send

API = "/api/"  # the page's files and the API's description answer HEAD by themselves
_OF_GET = (b"range",)  # which HEAD ignores (RFC 9110, 14.2)


class HeadRequests:
    """Middleware that answers HEAD with the head of GET's response, whose body is never begun.

    It comes before rights, limits and measurements, so that these are GET's.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on."""
        if scope["type"] != "http" or scope["method"] != "HEAD" or not scope["path"].startswith(API):
            await self._app(scope, receive, send)
            return
        ended = asyncio.Event()

        async def send_head(message: Message) -> None:
            await send(message)
            await send({"type": "http.response.body"})
            ended.set()
            await asyncio.Future()  # until it is cancelled

        answer = asyncio.ensure_future(self._app(_as_get(scope), receive, send_head))
        answer.add_done_callback(lambda _: ended.set())
        try:
            await ended.wait()
        finally:
            answer.cancel()
            await asyncio.wait({answer})
        if not answer.cancelled():
            answer.result()


def _as_get(scope: Scope) -> Scope:
    headers = [(name, value) for name, value in scope["headers"] if name not in _OF_GET]
    return {**scope, "method": "GET", "headers": headers}
