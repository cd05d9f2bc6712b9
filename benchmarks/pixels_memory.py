"""Measure the host memory of a training's pixels, as `paper` keeps them, by number of processes.

usage: python benchmarks/pixels_memory.py

Images are noise, so that no part of them can be skipped; masks are discs. Each process reads all pixels once, so that
all are in memory. The memory of all processes together is the sum of their proportional set sizes (Pss), which count a
page that several processes map once. Writes `benchmarks/results/pixels-memory.json` and `.md`.
"""

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
from provenance import arguments, provenance, provenance_line, table, write_result

from hnerf.capture.masks import Masks, encode
from hnerf.training.distributed import Distributed
from hnerf.training.gather import gather_pixels

PROCESSES = (1, 2, 4)
FRAMES, CAMERAS, SIZE_PX = 60, 8, 1024
GIB = 2**30


def main() -> None:
    """Measure, print and write."""
    arguments(__doc__).parse_args()
    where, rows = provenance(), {str(n): measure(n) for n in PROCESSES}
    size = f"{FRAMES} frames x {CAMERAS} cameras x {SIZE_PX} px"
    shown = [["processes", "all processes, GiB", "before pixels", "pixels", "peak while gathering"]]
    for n, row in rows.items():
        sizes = (row["all_gib"], row["before_gib"], row["all_gib"] - row["before_gib"], row["gathering_gib"])
        shown.append([n, *(f"{gib:.2f}" for gib in sizes)])
    result = where | {"size": size, "processes": rows}
    message = f"{size}; the last column is the gathering process's own memory, without the files that it writes."
    markdown = "\n".join(["# Host memory of pixels", "", provenance_line(result), "", message, "", *table(shown), ""])
    write_result("pixels-memory", result, markdown)


def measure(processes: int) -> dict[str, float]:
    """Return the GiB of all processes together before and after they get their pixels, and of the gathering process
    while it gathers."""
    with socket.socket() as free, TemporaryDirectory() as folder:
        free.bind(("127.0.0.1", 0))
        os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free.getsockname()[1])}
        free.close()
        multiprocessing.spawn(run_process, (processes, Path(folder)), processes)
        found = [json.loads((Path(folder) / f"{rank}.json").read_text()) for rank in range(processes)]
    return {
        "before_gib": sum(row["before"] for row in found) / GIB,
        "all_gib": sum(row["after"] for row in found) / GIB,
        "gathering_gib": found[0]["anonymous"] / GIB,
    }


def run_process(rank: int, processes: int, folder: Path) -> None:
    """Gather the pixels as process `rank`, and write its memory figures."""
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": str(processes)}
    torch.set_num_threads(1)
    here, found = Distributed.join(), {}
    capture, masks, body = synthetic_inputs()
    here.barrier()
    found["before"] = process_bytes("Pss")
    here.barrier()
    pixels = gather_pixels(capture, masks, body, None, {}, folder, here, with_plates=False)
    found["anonymous"] = capture.peak_bytes
    for column in (pixels.colour, pixels.person, pixels.edge):
        column.numpy().view(np.uint8).max()  # reads every byte; on bools max() would stop at the first True
    here.barrier()
    found["after"] = process_bytes("Pss")
    here.barrier()
    (folder / f"{rank}.json").write_text(json.dumps(found))


def process_bytes(name: str) -> int:
    """Return the bytes of this process under a name in Linux's smaps."""
    lines = Path("/proc/self/smaps_rollup").read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(f"{name}:"))


class Noise(SimpleNamespace):
    """A fake capture of noise images. peak_bytes: the most private memory held when an image was read."""

    peak_bytes = 0

    def image(self, camera: str, frame: int) -> np.ndarray:
        """Return a noise image, (H, W, 3) uint8."""
        self.peak_bytes = max(self.peak_bytes, process_bytes("Anonymous"))
        shape = self.cameras[camera].height_px, self.cameras[camera].width_px, 3
        return np.random.default_rng([int(camera), frame]).integers(0, 256, shape, np.uint8)

    def background(self, camera: str) -> None:
        """Return None, since there are no clean plates."""


def synthetic_inputs() -> tuple[Any, Any, Any]:
    """Return a fake capture, masks and body fit with the members that the gathering of whole images uses."""
    camera = SimpleNamespace(width_px=SIZE_PX, height_px=SIZE_PX, K=np.eye(3), R=np.eye(3), centre_m=np.zeros(3))
    names = tuple(f"{k}" for k in range(CAMERAS))
    by_name = {name: SimpleNamespace(**vars(camera), name=name) for name in names}
    body = SimpleNamespace(frames=tuple(range(FRAMES)), vertices_m=lambda: torch.zeros(FRAMES, 1, 3))
    y, x = np.ogrid[:SIZE_PX, :SIZE_PX]
    disc = encode((x - SIZE_PX // 2) ** 2 + (y - SIZE_PX // 2) ** 2 < (SIZE_PX // 4) ** 2)
    masks = Masks({(name, frame): disc for name in names for frame in body.frames}, {})
    return Noise(train_cameras=names, cameras=by_name), masks, body


if __name__ == "__main__":
    main()
