"""The live dashboard: a small Starlette application, read only, for this machine alone."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import quote

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware, RequestResponseEndpoint
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, PlainTextResponse, Response
from starlette.routing import Route

from src.dashboard.board import Board, BoardReader
from src.dashboard.render import Page, Renderer, content_policy

HOST = "127.0.0.1"
HOSTS = [HOST, "localhost"]
"""A page of another name that resolves to this machine is refused, so that no website can read the dashboard."""


def create_app(reports: Path, outputs: Path | None) -> Starlette:
    """The dashboard over these folders; a folder that is not there is shown as such."""
    reader = BoardReader(reports, outputs)
    reader.read()  # so that the first page does not wait for it
    renderer = Renderer(
        live_address, lambda picture: f"/pictures/{quote(picture.run_id)}/{quote(picture.name)}", live=True
    )

    def page(board: Board, mark: str, content: Page) -> Response:
        return HTMLResponse(renderer.document(board, [content], mark))

    def overview(request: Request) -> Response:
        board, mark = reader.read()
        return page(board, mark, renderer.overview(board))

    def sweep(request: Request) -> Response:
        board, mark = reader.read()
        found = board.sweep(request.path_params["key"])
        return page(board, mark, renderer.sweep(board, found)) if found else missing("sweep")

    def run(request: Request) -> Response:
        board, mark = reader.read()
        found = board.runs.get(request.path_params["run_id"])
        against = board.runs.get(request.query_params.get("against", ""))
        return page(board, mark, renderer.run(board, found, against)) if found else missing("run")

    def picture(request: Request) -> Response:
        board, _ = reader.read()
        found = board.folders.picture(request.path_params["run_id"], request.path_params["name"])
        return FileResponse(found.path, media_type="image/png") if found else missing("picture")

    def mark(request: Request) -> Response:
        return PlainTextResponse(reader.read()[1])

    def missing(kind: str) -> Response:
        return PlainTextResponse(f"There is no such {kind}. The overview, /, lists what there is.\n", 404)

    routes = [
        Route("/", overview),
        Route("/sweep/{key}", sweep),
        Route("/run/{run_id}", run),
        Route("/pictures/{run_id}/{name}", picture),
        Route("/mark", mark),
    ]
    return Starlette(
        routes=routes,
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=HOSTS, www_redirect=False), Middleware(_Headers)],
    )


def live_address(kind: str, name: str = "") -> str:
    """Addresses of the live dashboard."""
    if kind == "overview":
        return f"/#{quote(name)}" if name else "/"
    return f"/{kind}/{quote(name, safe='')}"


class _Headers(BaseHTTPMiddleware):
    """Tells browsers that pages load nothing from elsewhere and that no other site may use them."""

    async def dispatch(self, request: Request, call_next: RequestResponseEndpoint) -> Response:
        response = await call_next(request)
        response.headers.update(
            {
                "content-security-policy": content_policy(live=True),
                "x-content-type-options": "nosniff",
                "referrer-policy": "no-referrer",
                "cross-origin-resource-policy": "same-origin",
                "cache-control": "no-cache",
            }
        )
        return response
