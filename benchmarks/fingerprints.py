"""Fingerprint what short runs compute, to show that a change of the code changes no number.

usage: python benchmarks/fingerprints.py OUT.json [--scratch DIR]

Runs the pipeline from scratch on one thread with seed 0: the demo, `valid-wave` for 100 steps where `../shared` lies
beside this checkout, `paper-small` on one frame for 10 steps and each compared method for 20. Writes a digest of the
numbers in each run's masks, body, model and metrics (but seconds); names and layouts of files do not count. Takes some
ten minutes. Compare two files with `diff`.
"""

import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from provenance import ROOT, SHARED, arguments
from safetensors.numpy import load_file

HNERF = Path(sys.executable).with_name("hnerf")
FEW = ("evaluation.max_images=1", "evaluation.max_meshes=1", "evaluation.report_rows=1")
ASSET = ("asset.grid_cells=96", "asset.faces=4000", "asset.texture_px=256")
STATIC, DYNAMIC = ("nerf", "idr"), ("neural-body", "nerfies")
UNSTABLE = re.compile(r"second|_gib|device|machine|commit|path|protocol")  # depends on the machine or is text


def main() -> None:
    """Run all jobs and write their fingerprints."""
    parser = arguments(__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scratch", type=Path, help="a folder to keep (default: a temporary one)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        scratch = (options.scratch or Path(temporary)).resolve()
        found = {}
        for name, (capture, preset, changes) in jobs(scratch).items():
            print(name, flush=True)
            found[name] = fingerprint(run(capture, preset, changes, scratch / "stores" / name))
            options.out.write_text(json.dumps(found, indent=1) + "\n")


def jobs(scratch: Path) -> dict[str, tuple[Path, str, tuple[str, ...]]]:
    """Return capture, preset and changes of settings for each run."""
    moving, still = synthesise(scratch / "moving"), synthesise(scratch / "still", "train_frames=1")
    chosen: dict[str, tuple[Path, str, tuple[str, ...]]] = {"demo": (moving, "demo", ("asset.texture_px=256",))}
    wave = SHARED / "data" / "valid-wave"
    if wave.is_dir():
        chosen["wave"] = (wave, "fast", ("training.steps=100", "evaluation.max_images=4", *FEW[1:], *ASSET))
    chosen["paper-small"] = (still, "paper-small", ("training.steps=10", *FEW, *ASSET))
    for name in STATIC:
        chosen[name] = (still, name, ("training.steps=20", *FEW, *ASSET))
    for name in DYNAMIC:
        chosen[name] = (moving, name, ("training.steps=20", *FEW, *ASSET))
    return chosen


def synthesise(folder: Path, *changes: str) -> Path:
    """Write the synthetic capture, unless it exists."""
    if not folder.exists():
        call("synth", str(folder), *(f"--set={change}" for change in changes))
    return folder


def run(capture: Path, preset: str, changes: tuple[str, ...], store: Path) -> Path:
    """Run the pipeline; return the subject's folder. The asset of such a short training may be refused."""
    command = ["run", str(capture), "--preset", preset, "--store", str(store)]
    call(*command, *(f"--set={change}" for change in changes), may_fail=True)
    (subject,) = (store / "subjects").iterdir()
    return subject


def call(*arguments: str, may_fail: bool = False) -> None:
    """Run this checkout's hnerf on one thread."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    done = subprocess.run([str(HNERF), *arguments], env=environment, capture_output=True, text=True)
    if done.returncode:
        print(done.stdout[-500:], done.stderr[-500:], flush=True)
        if not may_fail:
            raise SystemExit(done.returncode)


def fingerprint(subject: Path) -> dict[str, str]:
    """Return a digest for each stage that has output."""
    found = {}
    masks = sorted(subject.glob("segmentation/**/*.png"))
    found["masks"] = digest(cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in masks)
    for name, path, load in (
        ("body", subject / "training" / "body.npz", np.load),
        ("model", subject / "training" / "model.safetensors", load_file),
    ):
        if path.exists():
            arrays = load(path)
            found[name] = digest(sorted((np.asarray(arrays[key]) for key in arrays), key=lambda a: digest([a])))
    metrics = subject / "evaluation" / "metrics.json"
    if metrics.exists():
        found["metrics"] = digest([np.array(list(numbers(json.loads(metrics.read_text()))))])
    return found


def numbers(value: Any) -> Iterator[float]:
    """Yield the numbers in a JSON value, in order."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if not UNSTABLE.search(key):
                yield from numbers(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from numbers(inner)
    elif isinstance(value, (int, float)):
        yield float(value)


def digest(arrays: Any) -> str:
    """Return the first 16 digits of the SHA-256 of the arrays' bytes."""
    total = hashlib.sha256()
    for array in arrays:
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()[:16]


if __name__ == "__main__":
    main()
