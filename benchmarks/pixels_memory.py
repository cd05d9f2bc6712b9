"""Measure the host memory of a training's pixels, as `paper` keeps them, by number of processes.

usage: python benchmarks/pixels_memory.py [--frames 60] [--cameras 8] [--size-px 1024]

Images are noise, so that no part of them can be skipped; masks are discs. Each process reads all pixels once, so that
all are in memory. The memory of all processes together is the sum of their proportional set sizes (Pss), which count a
page that several processes map once. Writes `benchmarks/results/pixels-memory.json` and `.md`.
"""

import argparse
import json
import os
import socket
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
import torch.multiprocessing as multiprocessing
from provenance import provenance, provenance_line, table, write_result

from hnerf.training.distributed import Distributed
from hnerf.training.gather import gather_pixels

PROCESSES = (1, 2, 4)
GIB = 2**30


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("frames", 60), ("cameras", 8), ("size-px", 1024)):
        parser.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args()
    rows = {str(n): measure(n, options.frames, options.cameras, options.size_px) for n in PROCESSES}
    size = f"{options.frames} frames x {options.cameras} cameras x {options.size_px} px"
    shown = [["processes", "all processes, GiB", "before pixels", "pixels", "peak while gathering"]]
    for n, row in rows.items():
        sizes = (row["all_gib"], row["before_gib"], row["all_gib"] - row["before_gib"], row["gathering_gib"])
        shown.append([n, *(f"{gib:.2f}" for gib in sizes)])
    result = provenance() | {"size": size, "processes": rows}
    message = f"{size}; the last column is the gathering process's own memory, without the files that it writes."
    markdown = "\n".join(["# Host memory of pixels", "", provenance_line(result), "", message, "", *table(shown), ""])
    write_result("pixels-memory", result, markdown)


def measure(processes: int, frames: int, cameras: int, size_px: int) -> dict[str, float]:
    """Return the GiB of all processes together before and after they have their pixels, and of the gathering one
    meanwhile."""
    with socket.socket() as free, TemporaryDirectory() as folder:
        free.bind(("127.0.0.1", 0))
        os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free.getsockname()[1])}
        free.close()
        multiprocessing.spawn(run_process, (processes, frames, cameras, size_px, Path(folder)), processes)
        found = [json.loads((Path(folder) / f"{rank}.json").read_text()) for rank in range(processes)]
    return {
        "before_gib": sum(row["before"] for row in found) / GIB,
        "all_gib": sum(row["after"] for row in found) / GIB,
        "gathering_gib": found[0]["anonymous"] / GIB,
    }


def run_process(rank: int, processes: int, frames: int, cameras: int, size_px: int, folder: Path) -> None:
    """Gather the pixels as process `rank`, and write its memory figures."""
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": str(processes)}
    torch.set_num_threads(1)
    here, found = Distributed.join(), {}
    capture, masks, body = synthetic_inputs(frames, cameras, size_px)
    here.barrier()
    found["before"] = process_bytes("Pss")
    here.barrier()
    pixels = gather_pixels(capture, masks, body, body.frames, None, {}, folder, here)
    found["anonymous"] = capture.peak_bytes
    for column in (pixels.colour, pixels.person, pixels.edge):
        column.numpy().view(np.uint8).max()  # reads every byte; on bools max() would stop at the first True
    here.barrier()
    found["after"] = process_bytes("Pss")
    here.barrier()
    (folder / f"{rank}.json").write_text(json.dumps(found))


def process_bytes(name: str) -> int:
    """Return the bytes of this process under a name of Linux's smaps."""
    lines = Path("/proc/self/smaps_rollup").read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(f"{name}:"))


class Noise(SimpleNamespace):
    """A fake capture of noise images. peak_bytes: the most bytes of its own that the process held when an image was
    read."""

    peak_bytes = 0

    def image(self, camera: str, frame: int) -> np.ndarray:
        """Return a noise image, (H, W, 3) uint8."""
        self.peak_bytes = max(self.peak_bytes, process_bytes("Anonymous"))
        shape = self.cameras[camera].height_px, self.cameras[camera].width_px, 3
        return np.random.default_rng([int(camera), frame]).integers(0, 256, shape, np.uint8)

    def background(self, camera: str) -> None:
        """Return None: there are no plates."""


class Discs(SimpleNamespace):
    """Fake masks of discs."""

    def __contains__(self, view: tuple[str, int]) -> bool:
        """Return True: every view has a mask."""
        return True

    def get(self, camera: str, frame: int) -> np.ndarray:
        """Return the mask, (H, W) bool."""
        y, x = np.ogrid[: self.size_px, : self.size_px]
        return (x - self.size_px // 2) ** 2 + (y - self.size_px // 2) ** 2 < (self.size_px // 4) ** 2


def synthetic_inputs(frames: int, cameras: int, size_px: int) -> tuple[Any, Any, Any]:
    """Return a fake capture, masks and body fit with what gathering whole images uses."""
    camera = SimpleNamespace(width_px=size_px, height_px=size_px, K=np.eye(3), R=np.eye(3), centre_m=np.zeros(3))
    names = tuple(f"{k}" for k in range(cameras))
    by_name = {name: SimpleNamespace(**vars(camera), name=name) for name in names}
    body = SimpleNamespace(frames=tuple(range(frames)), vertices_m=lambda: torch.zeros(frames, 1, 3))
    return Noise(train_cameras=names, cameras=by_name), Discs(size_px=size_px), body


if __name__ == "__main__":
    main()
