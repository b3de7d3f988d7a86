"""How every command starts and ends.

What takes time is imported inside, after ``run`` has seen to it that Ctrl-C ends the command by one line. SIGTERM,
by which systems end what runs too long or when they go down, is answered like Ctrl-C.
"""

import atexit
import errno
import gc
import os
import signal
import sys
import time
from types import ModuleType

PATIENCE_S = 3.0
"""Seconds after Ctrl-C in which another one changes nothing: the command is ending."""

FAILED = 1
"""Exit status where the machine gave no memory, or no room on a disk."""

_SIGNALS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}

LOST_OUTPUT = 1
"""Exit status where the output was all that was asked for, and could not be written."""


def run(command: str, *arguments: object) -> None:
    """Run ``memcomp-NAME``: the ``main`` of ``memcomp_lightning.cli.commands.NAME``."""
    before = _end_at_once(command)
    stop = _Stop(before)
    atexit.register(gc.freeze)  # a last look for garbage would take a fifth of a short run
    try:
        _run(command, arguments, stop)
    except Exception as error:  # also while modules are imported
        from memcomp_lightning.errors import lost

        if (said := lost(error)) is None:
            raise
        _write_line(f"{command}: {said} Go on with: {_typed(command)}")
        sys.exit(FAILED)
    finally:
        atexit.register(stop.ignore)
        if not stop.heard:
            stop.forget()


def _typed(command: str) -> str:
    import shlex

    return shlex.join([command, *sys.argv[1:]])


def _run(command: str, arguments: tuple[object, ...], stop: "_Stop") -> None:
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
            stop.listen()
            main(*arguments)
        except KeyboardInterrupt as interrupt:
            stop.ignore()
            rest = str(interrupt) or f"Go on with: {_typed(command)}"
            say(f"\n{command}: {_SIGNALS[stop.number]}. {rest}", error=True)
            sys.exit(128 + stop.number)
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


class _Stop:
    """What a signal does while a command runs: it raises a KeyboardInterrupt, and is not heard twice.

    A second one, of a person or of a system that is in a hurry, would come while what is finished is being kept.

    Attributes:
        number: The signal that came last.
        heard: Whether one came.
    """

    def __init__(self, before: dict[signal.Signals, object]) -> None:
        self.number = signal.SIGINT
        self.heard = False
        self._before, self._at = before, -PATIENCE_S

    def listen(self) -> None:
        """Answer the signals from here on."""
        for number in self._before:
            _answer(number, self)

    def forget(self) -> None:
        """Let the signals do what they did before."""
        for number, handler in self._before.items():
            _answer(number, handler)

    def ignore(self) -> None:
        """The command has ended, and says so."""
        for number in self._before:
            _answer(number, signal.SIG_IGN)

    def __call__(self, number: int, frame: object) -> None:
        now = time.monotonic()
        if now - self._at >= PATIENCE_S:
            self._at, self.number, self.heard = now, signal.Signals(number), True
            raise KeyboardInterrupt


def _end_at_once(command: str) -> dict[signal.Signals, object]:
    """Let signals end the process while modules are imported, and nothing is written; return what they did before.

    Libraries that are being imported would swallow the exception, or turn it into others.
    """

    def end(number: int, _: object) -> None:
        try:
            _write_line(f"\n{command}: {_SIGNALS[signal.Signals(number)]}, nothing was written.")
        finally:
            os._exit(128 + number)

    before: dict[signal.Signals, object] = {}
    for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL)):
        by_slurm = number == signal.SIGTERM and "SLURM_JOB_ID" in os.environ  # whose jobs Lightning may requeue
        if signal.getsignal(number) == usual and not by_slurm:  # a shell lets those in the background ignore some
            before[number] = usual
            _answer(number, end)
    return before


def _write_line(line: str) -> None:
    """Write to standard error, though nothing may be there to write by."""
    os.write(2, f"{line}\n".encode(errors="replace"))


def _answer(number: int, handler: object) -> None:
    try:  # noqa: SIM105 (contextlib would be one import more before Ctrl-C is answered)
        signal.signal(number, handler)  # type: ignore[arg-type]
    except (TypeError, ValueError):  # a handler that is not Python's; not the main thread
        pass
