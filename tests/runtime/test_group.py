"""The processes of a run as torchrun, SLURM and rgbt describe them."""

from __future__ import annotations

import pytest

from rgbt.checks import InputError
from rgbt.runtime.group import Group, first_host, group_from_environment

TORCHRUN = {
    **{"RANK": "5", "WORLD_SIZE": "8", "LOCAL_RANK": "1", "LOCAL_WORLD_SIZE": "4"},
    **{"MASTER_ADDR": "node1", "MASTER_PORT": "29500"},
}
SRUN = {
    **{"SLURM_JOB_ID": "1234", "SLURM_STEP_ID": "2", "SLURM_STEP_NUM_TASKS": "4"},
    **{"SLURM_PROCID": "3", "SLURM_LOCALID": "1", "SLURM_STEP_TASKS_PER_NODE": "2(x2)"},
    **{"SLURM_STEP_NODELIST": "gpu[07-08]", "SLURM_NTASKS": "4"},
}


def test_group_from_environment_of_torchrun() -> None:
    assert group_from_environment(TORCHRUN) == Group(5, 8, 1, 4, "node1", 29500, "torchrun")
    supervised = group_from_environment({**TORCHRUN, "RGBT_SUPERVISOR": "77"})
    assert supervised is not None
    assert supervised.is_supervised
    assert supervised.title == "process 5 of 8"


def test_group_from_environment_of_srun() -> None:
    port = 15_000 + (10 * 1234 + 2) % 15_000
    assert group_from_environment(SRUN) == Group(3, 4, 1, 2, "gpu07", port, "srun")
    named = group_from_environment({**SRUN, "MASTER_ADDR": "a", "MASTER_PORT": "4000"})
    assert named is not None
    assert (named.address, named.port) == ("a", 4000)


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {**TORCHRUN, "WORLD_SIZE": "1", "RANK": "0", "LOCAL_WORLD_SIZE": "1"},
        # In a batch script, with two tasks but without srun, one process runs.
        {"SLURM_NTASKS": "2", "SLURM_PROCID": "0", "SLURM_JOB_ID": "9"},
        {**SRUN, "SLURM_STEP_NUM_TASKS": "1", "SLURM_STEP_TASKS_PER_NODE": "1"},
        # Some services set these for their own use.
        {"RANK": "0", "WORLD_SIZE": "2", "MASTER_ADDR": "x"},
    ],
)
def test_group_from_environment_of_one_process_is_none(environment: dict[str, str]) -> None:
    assert group_from_environment(environment) is None


@pytest.mark.parametrize(
    ("environment", "sentence"),
    [
        ({**TORCHRUN, "RANK": "x"}, "RANK is 'x'"),
        ({**TORCHRUN, "WORLD_SIZE": "6"}, "torchrun started 6 processes, with 4 on this"),
        ({**SRUN, "SLURM_STEP_TASKS_PER_NODE": "3,1"}, r"machines of the job 3\+1; .*--ntasks"),
        ({**SRUN, "SLURM_STEP_TASKS_PER_NODE": ""}, "an unknown number"),
    ],
)
def test_group_from_environment_refuses(environment: dict[str, str], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        group_from_environment(environment)


@pytest.mark.parametrize(
    ("nodes", "first"),
    [
        *(("n1", "n1"), ("n1,n2", "n1"), ("n[3,5-7]", "n3"), ("gpu[007-9]-ib,x", "gpu007-ib")),
        ("", ""),
    ],
)
def test_first_host(nodes: str, first: str) -> None:
    assert first_host(nodes) == first
