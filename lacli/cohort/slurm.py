"""A study as a plain SLURM array, a task a patient, for sites that forbid long-lived schedulers."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from lacli.cohort.steps import Settings

_DEFAULTS = {"time": "48:00:00", "memory": "8G", "cpus": 4}


def array_script(program: str, call: Sequence[str], identifiers: Sequence[str], settings: Settings, logs: Path) -> str:
    """The batch script. program: Python with lacli in it; call: the arguments of ``lacli cohort`` without --only.

    identifiers and settings were checked: they hold nothing that a shell takes for its own.
    """
    chosen = {**_DEFAULTS, **settings.slurm}
    limit = f"%{chosen['limit']}" if "limit" in chosen else ""
    lines = [
        "#!/bin/bash",
        "#SBATCH --job-name=lacli-cohort",
        f"#SBATCH --array=0-{len(identifiers) - 1}{limit}",
        f"#SBATCH --time={chosen['time']}",
        f"#SBATCH --mem={chosen['memory']}",
        f"#SBATCH --cpus-per-task={chosen['cpus']}",
        f"#SBATCH --output={logs}/%A_%a.out",
    ]
    lines += [f"#SBATCH --{name}={chosen[name]}" for name in ("account", "partition") if name in chosen]
    lines += ["set -euo pipefail"]
    modules = chosen.get("modules", [])
    lines += [f"module load {shlex.quote(str(m))}" for m in (modules if isinstance(modules, list) else [modules])]
    lines += [
        f"patients=({' '.join(identifiers)})",
        f'{shlex.join([program, "-m", "lacli", *call])} --only "${{patients[$SLURM_ARRAY_TASK_ID]}}"',
    ]
    return "\n".join(lines) + "\n"
