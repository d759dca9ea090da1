"""`python -m src.dashboard [port=8000] [export=FILE]`: sweeps and runs in the browser, live or as one file.

Does without the run's configuration, and so without torch: the dashboard is there within a second.
"""

from __future__ import annotations

import contextlib
import difflib
import socket
import time
from pathlib import Path

import uvicorn
import yaml

from src.dashboard.server import HOST, create_app
from src.dashboard.single_file import export_dashboard
from src.errors import ConfigError
from src.reliability.command import run_command

CONFIG = Path(__file__).resolve().parents[2] / "conf" / "config.yaml"
PORT = 8000


def main(arguments: list[str]) -> None:
    """Serve until Ctrl-C, or with `export=FILE` write the file and end."""
    options = read_options(arguments)
    reports, outputs = Path(options["paths.reports"]), Path(options["paths.outputs"])
    if options["export"]:
        if not (reports.is_dir() or outputs.is_dir()):
            raise ConfigError(f"paths.reports={reports}, paths.outputs={outputs}: neither folder is there to export")
        start, path = time.perf_counter(), Path(options["export"])
        try:
            export_dashboard(reports, outputs, path)
        except OSError as error:
            raise ConfigError(f"export={path} cannot be written ({error.strerror}); choose another file") from error
        size, seconds = path.stat().st_size / 1e6, time.perf_counter() - start
        print(f"written: {path}, {size:.1f} MB in {seconds:.1f} s")
        return
    listener = listen(options["port"])
    print(f"http://{HOST}:{listener.getsockname()[1]}/  ({reports}, {outputs}; Ctrl-C ends it)", flush=True)
    server = uvicorn.Server(uvicorn.Config(create_app(reports, outputs), log_level="warning", lifespan="off"))
    with contextlib.suppress(KeyboardInterrupt):  # how a server ends
        server.run(sockets=[listener])


def read_options(arguments: list[str]) -> dict[str, str]:
    """port, export, paths.outputs and paths.reports from `key=value`s; the paths' defaults are those of every command.

    Raises ConfigError for anything else, naming what there is.
    """
    paths = yaml.safe_load(CONFIG.read_text())["paths"]
    options = {"port": str(PORT), "export": "", **{f"paths.{name}": paths[name] for name in ("outputs", "reports")}}
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if key not in options or not equals:
            near = difflib.get_close_matches(key, options, n=1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise ConfigError(f"{argument}: the dashboard takes {', '.join(f'{name}=' for name in options)}{hint}")
        if not value:
            raise ConfigError(f"{key} must not be empty")
        quoted = len(value) > 1 and value[0] == value[-1] and value[0] in "\"'"  # as the other commands need it
        options[key] = value[1:-1] if quoted else value
    return options


def listen(port: str) -> socket.socket:
    """A socket of this machine alone; port 0 takes any free one. Raises ConfigError for a port that cannot be had."""
    if not port.isdecimal() or int(port) > 65535:
        raise ConfigError(f"port must be a number from 0 to 65535, but got {port}")
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((HOST, int(port)))
        listener.listen()
    except OSError as error:
        listener.close()
        remedy = "is a dashboard already running? Choose another with port=N, or port=0 for any free one"
        raise ConfigError(f"port={port} of {HOST} cannot be used ({error.strerror}); {remedy}") from error
    return listener


if __name__ == "__main__":
    run_command(main)
