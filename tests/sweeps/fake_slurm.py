"""`sbatch`, `srun`, `sacct` and `scancel` for one machine: what submitit needs of SLURM.

They show that what is submitted is a proper script and how states are read, not how SLURM behaves.
"""

from __future__ import annotations

from pathlib import Path

SBATCH = """#!/bin/bash
if [ -e $STATE/refuse ]; then
  echo "sbatch: error: invalid partition specified: $(cat $STATE/refuse)" >&2; exit 1
fi
id=$(($(cat $STATE/last) + 1)); echo $id > $STATE/last
cp "$1" $STATE/$id.script; echo RUNNING > $STATE/$id.state
if [ -e $STATE/silent ]; then
  echo NODE_FAIL > $STATE/$id.state; echo "Submitted batch job $id"; exit 0
fi
( export SLURM_JOB_ID=$id SLURM_PROCID=0 SLURM_LOCALID=0 SLURM_NODEID=0
  setsid bash "$1" & echo $! > $STATE/$id.pid; wait $!
  grep -q RUNNING $STATE/$id.state && echo COMPLETED > $STATE/$id.state ) > /dev/null 2>&1 &
echo "Submitted batch job $id"
"""
SRUN = """#!/bin/bash
while [ "${1#--}" != "$1" ]; do
  case "$1" in --output|--error) shift 2;; *) shift;; esac
done
exec "$@"
"""
SACCT = """#!/bin/bash
echo "JobID|State|NodeList"
for file in $STATE/*.state; do echo "$(basename $file .state)|$(cat $file)|node1"; done
"""
SCANCEL = """#!/bin/bash
echo CANCELLED > $STATE/$1.state
group=$(cat $STATE/$1.pid)
kill -TERM -$group; sleep 1; kill -KILL -$group
"""


def install(folder: Path) -> dict[str, str]:
    """Write the programs; the variables that make them be found, with their state in STATE."""
    state, programs = folder / "state", folder / "bin"
    state.mkdir(parents=True)
    programs.mkdir()
    (state / "last").write_text("100")
    written = {"sbatch": SBATCH, "srun": SRUN, "sacct": SACCT, "scancel": SCANCEL}
    for name, text in written.items():
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    return {"STATE": str(state), "PATH": f"{programs}:/usr/bin:/bin"}
