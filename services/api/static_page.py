"""Serves the built dashboard at `/`."""

from html import escape
from pathlib import Path

from starlette.exceptions import HTTPException
from starlette.responses import HTMLResponse, Response
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Receive, Scope, Send

DASHBOARD = Path(__file__).parents[1] / "dashboard" / "dist"
HASHED = "/assets/"  # Vite puts the hash of a file's content into these names
API = "/api/"

# Everything is served from here. three.js loads the textures of a GLB through blob: addresses.
POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "font-src 'self'",
        "img-src 'self' blob: data:",
        "media-src 'self' blob:",
        "connect-src 'self' blob:",
        "worker-src 'self' blob:",
        "manifest-src 'self'",
        "form-action 'none'",
        "base-uri 'none'",
        "frame-ancestors 'none'",
    )
)
_HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}
_NOT_BUILT = f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><title>Deltalight</title>
<h1>The dashboard is not built</h1>
<p>Run <code>./run api</code>, <code>./run up</code> or <code>./run demo</code> in the project's folder: they build it
into <code>{escape("services/dashboard/dist")}</code> first. An installed package brings it.</p>
<p>The REST API works without it: <a href="/api/v1/state">state</a>, <a href="/api/v1/live.mjpg">live picture</a>,
<a href="/openapi.json">description</a>.</p>
</html>
"""


class StaticPage:
    """Serves all addresses without a route; `otherwise` handles unknown addresses of the API."""

    def __init__(self, otherwise: ASGIApp, folder: Path | None = None) -> None:
        folder = folder or DASHBOARD
        self._otherwise = otherwise
        self._index = folder / "index.html"
        self._files = StaticFiles(directory=folder, html=True, check_dir=False)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answers a request."""
        path = scope["path"]
        if scope["type"] != "http" or path.startswith(API):
            await self._otherwise(scope, receive, send)
            return
        answer = await self._answer(scope)
        answer.headers.update(_HEADERS)
        answer.headers["Cache-Control"] = _cache_control(path, answer)
        await answer(scope, receive, send)

    async def _answer(self, scope: Scope) -> Response:
        if scope["path"] == "/" and not self._index.is_file():
            return HTMLResponse(_NOT_BUILT, 503)
        path = self._files.get_path(scope)
        if "\0" in path:  # which older versions of Starlette hand to the system
            raise HTTPException(404)
        return await self._files.get_response(path, scope)


def _cache_control(path: str, answer: Response) -> str:
    is_hashed = path.startswith(HASHED) and answer.status_code in (200, 304)
    return "public, max-age=31536000, immutable" if is_hashed else "no-cache"
