"""For all tests: signals as a terminal has them."""

import signal

from tests import running  # noqa: F401, sets up the server that processes are forked from


def pytest_configure(config):
    """A shell's background job ignores SIGINT, and so would the commands that tests start and interrupt."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
