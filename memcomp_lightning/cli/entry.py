"""How every command starts and ends. Light: what is heavy is imported where Ctrl-C is already answered."""

import errno
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from memcomp_lightning import __version__, compiling
from memcomp_lightning.cli.output import say, tolerant_streams

INTERRUPTED = 130
"""Exit status after Ctrl-C."""

LOST_OUTPUT = 1
"""Exit status where the output was all that was asked for, and could not be written."""


def run(command: str, *arguments: Any) -> None:
    """Run ``memcomp-NAME``: the ``main`` of ``memcomp_lightning.cli.commands.NAME``.

    Args:
        command: Its name.
        arguments: Of its main.
    """
    if {"--version", "-V"} & set(sys.argv[1:]):
        with tolerant_streams() as failures:
            say(f"{command} {__version__}")
        sys.exit(LOST_OUTPUT if failures else 0)
    with tolerant_streams() as failures, _told_of_compilation(command):
        try:
            with _ended_at_once(command):
                name = command.removeprefix("memcomp-")
                main = import_module(f"memcomp_lightning.cli.commands.{name}").main
            main(*arguments)
        except KeyboardInterrupt as interrupt:
            say(f"\n{command}: interrupted. {interrupt}".rstrip(), error=True)
            sys.exit(INTERRUPTED)
        finally:
            sys.stdout.flush()
            if failures and failures[0].errno != errno.EPIPE:  # head(1) has read enough
                say(f"{command}: not all of the output could be written ({failures[0].strerror}).", error=True)


@contextmanager
def _ended_at_once(command: str) -> Iterator[None]:
    """Let Ctrl-C end the process within this block, in which nothing is written.

    Libraries that are being imported would swallow the exception, or turn it into others.
    """

    def end(*_: object) -> None:
        say(f"\n{command}: interrupted, nothing was written.", error=True)
        os._exit(INTERRUPTED)

    before = signal.getsignal(signal.SIGINT)
    if before is not signal.default_int_handler or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _told_of_compilation(command: str) -> Iterator[None]:
    """Print what ``compiling`` logs, before Hydra has set up logging as well as after it, as one plain line."""
    log, handler = logging.getLogger(compiling.__name__), logging.Handler()
    handler.emit = lambda record: say(f"{command}: {record.getMessage()}", error=True)  # type: ignore[method-assign]
    before = log.level, log.propagate
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    log.propagate = False
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(before[0])
        log.propagate = before[1]
