"""Python programs in forks of a process that has imported the libraries, which takes seconds.

``forked_python.py -m MODULE WORDS`` and ``-c CODE WORDS`` do what ``python`` does with these words:
a server forks a process that has their folder, variables and streams. It is for programs that are
waited for; a signal reaches the client alone, and ends its program. Tests of what Python imports,
of signals and of the first moment of a program start Python itself.
"""

from __future__ import annotations

import json
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

SOCKET = "RGBT_TESTS_FORKED"
"""Variable: the socket of the server."""


def ask(words: list[str]) -> int:
    """Run a program in a fork of the server; its exit code, 70 if it was killed."""
    with socket.socket(socket.AF_UNIX) as server:
        server.connect(os.environ[SOCKET])
        request = json.dumps([words, str(Path.cwd()), dict(os.environ)]).encode()
        socket.send_fds(server, [len(request).to_bytes(4, "big")], [0, 1, 2])
        server.sendall(request)
        return (server.recv(1) or b"\x46")[0]


def serve(path: str) -> None:
    """Fork a process for each client, until the standard input ends."""
    import selectors
    import signal

    import sweeps.run.preload  # noqa: F401 - the libraries, and the modules of rgbt

    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for a program but its client
    with socket.socket(socket.AF_UNIX) as server, selectors.DefaultSelector() as selector:
        server.bind(path)
        server.listen(64)
        selector.register(server, selectors.EVENT_READ)
        selector.register(sys.stdin, selectors.EVENT_READ)
        print("ready", flush=True)
        while all(key.fileobj is server for key, _ in selector.select()):
            client, _ = server.accept()
            if os.fork() == 0:
                server.close()
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                answer(client)
            client.close()


def answer(client: socket.socket) -> None:
    """Become the program of a client, and end with it."""
    import atexit
    import threading
    import traceback

    code = 1
    try:
        prepare(client)
        run(sys.argv)
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
    finally:
        try:
            threading._shutdown()  # type: ignore[attr-defined] # waits for threads, as at every end
            atexit._run_exitfuncs()
            sys.stdout.flush()
            sys.stderr.flush()
            client.send(bytes([code % 256]))
        finally:
            os._exit(code % 256)


def prepare(client: socket.socket) -> None:
    """Take the words, the folder, the variables and the streams of a client."""
    import threading

    size, streams, _, _ = socket.recv_fds(client, 4, 3)
    request = client.recv(int.from_bytes(size, "big"), socket.MSG_WAITALL)
    words, folder, variables = json.loads(request)
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    os.setsid()
    os.chdir(folder)
    added = variables.get("PYTHONPATH", "").split(os.pathsep)
    sys.path[:0] = ["", *(each for each in added if each and each not in sys.path)]
    os.environ.clear()
    os.environ.update(variables)
    sys.argv, sys.orig_argv = words, [sys.executable, *words]

    def end_with_client() -> None:
        if not client.recv(1):
            os.killpg(0, 15)

    threading.Thread(target=end_with_client, daemon=True).start()


def run(words: list[str]) -> None:
    """Execute ``-m MODULE WORDS`` or ``-c CODE WORDS``."""
    import runpy

    option, what, *rest = words
    sys.argv = [option, *rest]
    if option == "-m":
        runpy.run_module(what, run_name="__main__", alter_sys=True)
    else:
        exec(compile(what, "<string>", "exec"), {"__name__": "__main__"})


@contextmanager
def server(folder: Path) -> Iterator[dict[str, str]]:
    """A server with its socket in `folder`; the variables that lead a client to it."""
    import subprocess

    path = str(folder / "socket")
    command = [sys.executable, "-m", "tests.forked_python", "serve", path]
    pipe, root = subprocess.PIPE, Path(__file__).parents[1]
    with subprocess.Popen(command, cwd=root, stdin=pipe, stdout=pipe) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        try:
            yield {SOCKET: path}
        finally:
            process.stdin.close()


PYTHON = f"{sys.executable} -S -E {__file__}"
"""What stands for ``python`` in a shell script."""

if __name__ == "__main__":
    if sys.argv[1] == "serve":
        serve(sys.argv[2])
    else:
        sys.exit(ask(sys.argv[1:]))
