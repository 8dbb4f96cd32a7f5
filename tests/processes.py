"""Run a function in several processes of one process group, as a training on several devices."""

from __future__ import annotations

import io
import multiprocessing
import os
import time
import traceback
from collections.abc import Callable, Mapping
from datetime import timedelta
from multiprocessing.connection import Connection, wait
from typing import Any

import torch
from torch import distributed
from torch.distributed import TCPStore

HOST = "127.0.0.1"
START_S = 60.0
"""Longest time for the processes to meet."""

# Processes of a fork server start in milliseconds, because it has imported these already.
PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload(["tests.processes", "scipy.optimize", "cv2", "lightning_fabric"])


def run_in_processes(
    function: Callable[..., Any],
    num_processes: int,
    *args: Any,
    limit_s: float = 120.0,
    environment: Mapping[str, str] | None = None,
) -> list[Any]:
    """What ``function(*args)`` returns in each of the processes, by rank.

    They form a gloo group on the loopback device, with one thread each. `function` is defined in a
    module, and what it takes and returns can be pickled.

    Args:
        function: called in every process.
        num_processes: W.
        args: of the function.
        limit_s: wall-clock time after which all processes are killed.
        environment: variables that are set in the processes.

    Raises:
        AssertionError: with the traceback of the first process that failed, or that took too long.
    """
    # The system chooses a free port; the store keeps it until the function returns.
    store = TCPStore(HOST, 0, is_master=True, wait_for_workers=False)
    started: list[tuple[Any, Connection]] = []
    for rank in range(num_processes):
        ours, theirs = PROCESSES.Pipe(duplex=False)
        given = (function, args, rank, num_processes, store.port, theirs, dict(environment or {}))
        process = PROCESSES.Process(target=_run, args=given)  # it may start loader processes
        process.start()
        theirs.close()
        started.append((process, ours))
    try:
        return _results([connection for _, connection in started], time.monotonic() + limit_s)
    finally:
        for process, connection in started:
            process.kill()
            process.join()
            connection.close()


def _results(connections: list[Connection], deadline: float) -> list[Any]:
    found: dict[int, Any] = {}
    while len(found) < len(connections):
        waiting = [each for rank, each in enumerate(connections) if rank not in found]
        ready = wait(waiting, max(0.0, deadline - time.monotonic()))
        missing = [rank for rank in range(len(connections)) if rank not in found]
        assert ready, f"processes {missing} did not return in time"
        for connection in ready:
            rank = connections.index(connection)  # type: ignore[arg-type]
            try:
                received = io.BytesIO(connections[rank].recv_bytes())
                failure, result = torch.load(received, weights_only=False)
            except EOFError:
                failure, result = "it ended without a result", None
            assert not failure, f"process {rank} failed: {failure}"
            found[rank] = result
    return [found[rank] for rank in range(len(connections))]


def _run(
    function: Callable[..., Any],
    args: tuple[Any, ...],
    rank: int,
    num_processes: int,
    port: int,
    connection: Connection,
    environment: dict[str, str],
) -> None:
    try:
        os.environ.update({"GLOO_SOCKET_IFNAME": "lo", **environment})
        torch.set_num_threads(1)
        distributed.init_process_group(
            "gloo",
            store=TCPStore(HOST, port, is_master=False),
            rank=rank,
            world_size=num_processes,
            timeout=timedelta(seconds=START_S),
        )
        answer = ("", function(*args))
    except BaseException:
        answer = (traceback.format_exc(), None)
    written = io.BytesIO()
    torch.save(answer, written)  # pickling alone would take a millisecond for each tensor
    connection.send_bytes(written.getvalue())
    # Killed here, so that no process leaves the group while another one needs it.
    parent = multiprocessing.parent_process()
    assert parent is not None, "started by `run_in_processes`"
    wait([parent.sentinel])
