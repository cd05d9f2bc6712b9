"""The machine on which measurements were taken."""

import os
import platform
from pathlib import Path

import torch

from hnerf.results.scores import Machine


def machine() -> Machine:
    """Return the processor, its cores and how many of them torch uses, the GPU (None if there is none), and the
    versions on which speed depends."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": names[0] if names else platform.processor(),
        "cores": len(os.sched_getaffinity(0)),
        "threads": torch.get_num_threads(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def describe_machine(found: Machine) -> str:
    """Describe a result of `machine` as a part of a sentence."""
    cores, gpu = f"{found['threads']} of {found['cores']} cores", found["gpu"] or "no GPU"
    return f"{found['cpu']}, {cores}, {gpu}, torch {found['torch']}, Python {found['python']}"
