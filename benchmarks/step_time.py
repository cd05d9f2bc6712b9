"""Measure the CPU time of a training step and of an image, beside another checkout in the same run.

usage: python benchmarks/step_time.py SUBJECT [--beside CHECKOUT] [--set training.steps=200 ...]

Trains preset `fast` again from a finished subject's capture, cameras, masks and fit, on one thread, and renders its
test views (24 at most). Two checkouts take turns of a second on one core, so that both meet the same machine: compare
their ratio, not the seconds, where others use the machine, too. Seconds are CPU time; PSNR is that of the images
against the capture's ground truth. Prints one line for each checkout.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from provenance import ROOT, SHARED

TURN_S = 1.0
IMAGES = 24


def main() -> None:
    """Run the checkouts in turns and print what each measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subject", type=Path)
    parser.add_argument("--beside", type=Path)
    parser.add_argument("--set", action="append", default=[], dest="changes")
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        measure(options.subject, options.changes)
    else:
        checkouts = [ROOT] if options.beside is None else [ROOT, options.beside.resolve()]
        for checkout, found in zip(checkouts, in_turns(checkouts, options.subject, options.changes), strict=True):
            print(checkout.name, found, flush=True)


def in_turns(checkouts: list[Path], subject: Path, changes: list[str]) -> list[str]:
    """Return what a process of each checkout prints; only one runs at a time, all on one core."""
    core = max(os.sched_getaffinity(0))
    environment = os.environ | {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    command = [sys.executable, __file__, str(subject.resolve()), "--measure", *(f"--set={c}" for c in changes)]
    with tempfile.TemporaryFile("w+") as errors:
        running = [
            subprocess.Popen(
                command,
                env=environment | {"PYTHONPATH": str(checkout)},
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            )
            for checkout in checkouts
        ]
        try:
            for process in running:
                os.sched_setaffinity(process.pid, {core})
                process.send_signal(signal.SIGSTOP)
            while waiting := [process for process in running if process.poll() is None]:
                for process in waiting:
                    process.send_signal(signal.SIGCONT)
                    time.sleep(TURN_S)
                    process.send_signal(signal.SIGSTOP)
        finally:
            for process in running:
                process.kill()
        errors.seek(0)
        found = [process.communicate()[0].strip() for process in running]
        if not all(found):
            raise SystemExit(errors.read()[-2000:])
    return found


def measure(subject: Path, changes: list[str]) -> None:
    """Train and render with the hnerf that is imported; print the figures as JSON."""
    import torch

    from hnerf.avatar.trained import load_avatar
    from hnerf.body.fit_result import BodyFit
    from hnerf.calibration.report import load_cameras
    from hnerf.capture.capture import Capture
    from hnerf.capture.masks import Masks
    from hnerf.config import load_settings
    from hnerf.evaluation.ground_truth import GroundTruth
    from hnerf.evaluation.images import render, score_split
    from hnerf.evaluation.views import all_views, sample_views
    from hnerf.training.distributed import Distributed
    from hnerf.training.trainer import Trainer

    torch.set_num_threads(1)
    capture = load_cameras(subject / "calibration", Capture.load(subject / "capture"))
    masks, body = Masks.load(subject / "segmentation"), BodyFit.load(subject / "fit")
    settings = load_settings("fast", changes).training
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        trainer = Trainer(capture, masks, body, settings, out, Distributed.join())
        started = time.process_time()
        trainer.run()
        found = {"steps": trainer.steps, "s_a_step": (time.process_time() - started) / trainer.steps}
        avatar = load_avatar(out)
        truth = GroundTruth(SHARED / "data" / capture.name, capture)
        for split in ("novel_view", "novel_pose"):
            views = sample_views(all_views(capture, split), IMAGES // 2)
            started = time.process_time()
            render({split: avatar}, capture, views, out)
            found[f"s_an_image, {split}"] = (time.process_time() - started) / len(views)
            scores = score_split(capture, split, views, truth, out)
            found[f"{split}"] = f"{scores['psnr']:.2f} / {scores['ssim']:.4f}"
    print(json.dumps({k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in found.items()}))


if __name__ == "__main__":
    main()
