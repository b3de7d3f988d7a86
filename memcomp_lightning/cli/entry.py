"""How every command starts and ends.

What takes time is imported inside, after ``run`` has seen to it that Ctrl-C ends the command by one line.
"""

import atexit
import errno
import gc
import os
import signal
import sys
from types import ModuleType

INTERRUPTED = 130
"""Exit status after Ctrl-C."""

LOST_OUTPUT = 1
"""Exit status where the output was all that was asked for, and could not be written."""


def run(command: str, *arguments: object) -> None:
    """Run ``memcomp-NAME``: the ``main`` of ``memcomp_lightning.cli.commands.NAME``."""
    before = _end_at_once_on_interrupt(command)
    atexit.register(gc.freeze)  # a last look for garbage would take a fifth of a short run
    try:
        _run(command, arguments, before)
    finally:
        _answer_interrupts(before)


def _run(command: str, arguments: tuple[object, ...], on_interrupt: object) -> None:
    from memcomp_lightning import __version__
    from memcomp_lightning.cli.output import say, tolerant_streams
    from memcomp_lightning.compiling import told

    if {"--version", "-V"} & set(sys.argv[1:]):
        with tolerant_streams() as failures:
            say(f"{command} {__version__}")
        sys.exit(LOST_OUTPUT if failures else 0)
    with tolerant_streams() as failures, told(lambda text: say(f"{command}: {text}", error=True)):
        try:
            main = _imported(f"memcomp_lightning.cli.commands.{command.removeprefix('memcomp-')}").main
            _answer_interrupts(on_interrupt)
            main(*arguments)
        except KeyboardInterrupt as interrupt:
            say(f"\n{command}: interrupted. {interrupt}".rstrip(), error=True)
            sys.exit(INTERRUPTED)
        finally:
            sys.stdout.flush()
            if failures and failures[0].errno != errno.EPIPE:  # head(1) has read enough
                say(f"{command}: not all of the output could be written ({failures[0].strerror}).", error=True)


def _imported(name: str) -> ModuleType:
    """Import a module without looking for garbage among what stays: that would take a fifth of a short run."""
    from importlib import import_module

    if name not in sys.modules and gc.isenabled():
        gc.disable()
        try:
            import_module(name)
        finally:
            gc.freeze()
            gc.enable()
    return import_module(name)


def _end_at_once_on_interrupt(command: str) -> object:
    """Let Ctrl-C end the process while modules are imported, and nothing is written; return what it did before.

    Libraries that are being imported would swallow the exception, or turn it into others.
    """

    def end(*_: object) -> None:
        line = f"\n{command}: interrupted, nothing was written.\n".encode()
        try:
            os.write(2, line)
        finally:
            os._exit(INTERRUPTED)

    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # a shell lets processes in the background ignore it
        _answer_interrupts(end)
    return before


def _answer_interrupts(handler: object) -> None:
    try:  # noqa: SIM105 (contextlib would be one import more before Ctrl-C is answered)
        signal.signal(signal.SIGINT, handler)  # type: ignore[arg-type]
    except (TypeError, ValueError):  # a handler that is not Python's; not the main thread
        pass
