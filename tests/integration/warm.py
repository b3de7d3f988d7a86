"""Start Python programs without importing everything again: each is a fork of a process that has imported it.

``python warm.py SOCKET MODULE...`` imports the modules and waits; a request on the socket is the arguments of
``python``, a folder and an environment, with the descriptors of the program's input, output and errors, and of a
pipe for its process number and exit status. The program sees what it would see if it was started alone, but for
modules that are imported already.
"""

import importlib
import json
import os
import runpy
import signal
import socket
import sys
from pathlib import Path
from typing import NamedTuple


class Request(NamedTuple):
    arguments: list[str]
    folder: str
    environment: dict[str, str]


def requested(channel: socket.socket) -> Request:
    """Wait for requests, one child for each; return in the process that is to become the program."""
    while True:
        message, descriptors, *_ = socket.recv_fds(channel, 2**20, 4)
        if not message:
            os._exit(0)
        if os.fork() == 0:
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            channel.close()
            if (program := os.fork()) == 0:
                return begun(Request(*json.loads(message)), descriptors)
            os.write(descriptors[3], b"%d\n" % program)
            for descriptor in descriptors[:3]:
                os.close(descriptor)
            _, status = os.waitpid(program, 0)
            os.write(descriptors[3], b"%d\n" % os.waitstatus_to_exitcode(status))
            os._exit(0)
        for descriptor in descriptors:
            os.close(descriptor)


def begun(request: Request, descriptors: list[int]) -> Request:
    for target, source in enumerate(descriptors[:3]):
        os.dup2(source, target)
    for descriptor in descriptors:
        os.close(descriptor)
    os.chdir(request.folder)
    os.environ.clear()
    os.environ.update(request.environment)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    return request


def run(request: Request) -> None:
    """As ``python ARGUMENTS``: ``-m MODULE``, ``-c CODE`` or a file."""
    first, *rest = request.arguments
    places = [place for place in request.environment.get("PYTHONPATH", "").split(os.pathsep) if place]
    sys.path[:1] = ["" if first.startswith("-") else str(Path(first).resolve().parent), *places]
    if first == "-m":
        sys.argv = rest
        runpy.run_module(rest[0], run_name="__main__", alter_sys=True)
    elif first == "-c":
        sys.argv = ["-c", *rest[1:]]
        exec(compile(rest[0], "<string>", "exec"), {"__name__": "__main__"})
    else:
        sys.argv = request.arguments
        runpy.run_path(first, run_name="__main__")


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for them here
    for module in sys.argv[2:]:
        importlib.import_module(module)
    run(requested(socket.socket(fileno=int(sys.argv[1]))))
