"""`python -m src.dashboard` as a command: options, a port that is taken, Ctrl-C, the exported file."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request

import pytest

from src.dashboard.__main__ import listen, read_options
from src.errors import ConfigError


def command(*arguments):
    return [sys.executable, "-m", "src.dashboard", *arguments]


def run(*arguments):
    return subprocess.run(command(*arguments), capture_output=True, text=True, timeout=60)


def test_paths_come_from_the_configuration_of_every_command():
    options = read_options([])
    assert options == {"port": "8000", "export": "", "paths.outputs": "outputs", "paths.reports": "reports"}
    options = read_options(["paths.outputs='a=b c'", "port=0", "export=x=y.html"])
    assert (options["paths.outputs"], options["port"], options["export"]) == ("a=b c", "0", "x=y.html")


@pytest.mark.parametrize(
    "argument, said",
    [("prot=1", "did you mean port"), ("--port", "takes port="), ("port", "takes port="), ("model.x=1", "takes port="),
     ("port=", "must not be empty"), ("phase=phase1", "takes port=")],
)  # fmt: skip
def test_other_options_are_refused(argument, said):
    with pytest.raises(ConfigError, match=said):
        read_options([argument])


@pytest.mark.parametrize("port", ["-1", "65536", "http", "8000.5", "\N{SUPERSCRIPT TWO}"])
def test_a_port_is_a_number(port):
    with pytest.raises(ConfigError, match="port must be a number from 0 to 65535"):
        listen(port)


def test_only_this_machine_is_listened_to():
    with listen("0") as listener:
        assert listener.getsockname()[0] == "127.0.0.1"


def test_a_taken_port_is_an_error_with_a_remedy(tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        ended = run(f"port={port}", f"paths.reports={tmp_path}", f"paths.outputs={tmp_path}")
    assert ended.returncode == 3
    assert f"port={port} of 127.0.0.1 cannot be used" in ended.stderr and "port=0" in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.mark.slow
def test_export_writes_a_page_without_torch(tmp_path):
    target = tmp_path / "new" / "dashboard.html"
    ended = run(f"export={target}", f"paths.reports={tmp_path}", f"paths.outputs={tmp_path / 'none'}")
    assert ended.returncode == 0, ended.stderr
    assert f"written: {target}" in ended.stdout
    assert "No runs yet" in target.read_text()
    heavy = {"torch", "lightning", "hydra", "matplotlib"}
    code = f"import src.dashboard.__main__, sys; sys.exit(bool({heavy} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


def test_export_to_where_nothing_can_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    ended = run(f"export={tmp_path}/file/x.html", f"paths.reports={tmp_path}")
    assert ended.returncode == 3 and "Traceback" not in ended.stderr and "file" in ended.stderr


def test_export_of_folders_that_are_not_there(tmp_path):
    target = tmp_path / "x.html"
    ended = run(f"export={target}", f"paths.reports={tmp_path / 'a'}", f"paths.outputs={tmp_path / 'b'}")
    assert ended.returncode == 3 and "neither folder is there" in ended.stderr
    assert not target.exists()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_serves_until_it_is_told_to_stop(tmp_path, number):
    log = (tmp_path / "log").open("w")
    arguments = command("port=0", f"paths.reports={tmp_path}", f"paths.outputs={tmp_path}")
    # A shell's background job ignores Ctrl-C; a terminal's does not.
    server = subprocess.Popen(
        arguments, stdout=subprocess.PIPE, stderr=log, text=True, env=os.environ,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    try:
        address = re.match(r"http://127\.0\.0\.1:\d+/", server.stdout.readline()).group()
        with urllib.request.urlopen(address, timeout=20) as answer:
            assert b"Experiments" in answer.read()
        server.send_signal(number)
        deadline = time.monotonic() + 20
        while server.poll() is None and time.monotonic() < deadline:
            time.sleep(0.05)
        assert server.returncode == 0, (tmp_path / "log").read_text()
    finally:
        server.kill()
        server.wait()
        log.close()
