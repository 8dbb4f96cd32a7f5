"""Run a function in several processes of one process group, as a training on several devices."""

from __future__ import annotations

import io
import multiprocessing
import os
import traceback
from collections.abc import Callable
from datetime import timedelta
from multiprocessing.connection import Connection, wait
from typing import Any

import torch
from torch import distributed
from torch.distributed import TCPStore

HOST = "127.0.0.1"

# Processes of a fork server start in milliseconds, because it has imported these already.
PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload(["tests.processes", "scipy.optimize", "cv2", "lightning_fabric"])


def run_in_processes(function: Callable[..., Any], num_processes: int, *args: Any) -> list[Any]:
    """What ``function(*args)`` returns in each of the processes, by rank.

    They form a gloo group on the loopback device, with one thread each. `function` is defined in a
    module, and what it takes and returns can be pickled.

    Raises:
        AssertionError: with the tracebacks of the processes that failed, or took two minutes.
    """
    # The system chooses a free port; the store keeps it until the function returns.
    store = TCPStore(HOST, 0, is_master=True, wait_for_workers=False)
    started, answers = [], []
    for rank in range(num_processes):
        ours, theirs = PROCESSES.Pipe(duplex=False)
        given = (function, args, rank, num_processes, store.port, theirs)
        started.append((PROCESSES.Process(target=_run, args=given), ours))
        started[-1][0].start()
        theirs.close()
    try:
        for _, ours in started:
            assert ours.poll(120), "a process did not return in time"
            answers.append(torch.load(io.BytesIO(ours.recv_bytes()), weights_only=False))
    finally:
        for process, ours in started:
            process.kill()
            process.join()
            ours.close()
    failures = "".join(failure for failure, _ in answers)
    assert not failures, failures
    return [found for _, found in answers]


def _run(
    function: Callable[..., Any],
    args: tuple[Any, ...],
    rank: int,
    size: int,
    port: int,
    connection: Connection,
) -> None:
    try:
        os.environ["GLOO_SOCKET_IFNAME"] = "lo"
        torch.set_num_threads(1)
        store, limit = TCPStore(HOST, port, is_master=False), timedelta(seconds=300)
        distributed.init_process_group(
            "gloo", store=store, rank=rank, world_size=size, timeout=limit
        )
        answer = ("", function(*args))
    except BaseException:
        answer = (f"process {rank}: {traceback.format_exc()}", None)
    written = io.BytesIO()
    torch.save(answer, written)  # pickling alone would take a millisecond for each tensor
    connection.send_bytes(written.getvalue())
    # Killed here, so that no process leaves the group while another one needs it.
    parent = multiprocessing.parent_process()
    assert parent is not None, "started by `run_in_processes`"
    wait([parent.sentinel])
