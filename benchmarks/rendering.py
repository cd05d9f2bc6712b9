"""Measure the time to render a frame of finished subjects, on one core and on all.

usage: python benchmarks/rendering.py STORE [CAPTURE ...]

Renders the first training pose of each shared capture (default: the three rendered ones), trained by preset `fast`
unless STORE has it, from its first test camera, or first training camera if it has no test camera, as an image whose
longest side is 256 and 512 px; on a GPU if there is one. Reports medians. Run it on an idle machine. Writes
`benchmarks/results/rendering.json` and `.md`.
"""

from pathlib import Path

import torch
from provenance import SHARED, provenance, provenance_line, store_and_captures, table, write_result

from flows.train_subject import train_subject
from hnerf.avatar.finished import avatar_of, recording_of
from hnerf.study.benchmark.scoring import frame_seconds

CAPTURES = ("valid-wave", "valid-walk", "valid-turn-mono")
SIDES_PX = (256, 512)


def main() -> None:
    """Train, render, print and write."""
    options = store_and_captures(__doc__, CAPTURES)
    result = provenance()
    threads = result["machine"]["threads"]
    cores = [threads] if torch.cuda.is_available() else sorted({1, threads})
    subjects = [train_subject.fn(SHARED / "data" / name, "fast", options.store).subject for name in options.captures]
    result["seconds"] = {subject.name: measure(subject, cores) for subject in subjects}
    rows = [["subject", *(f"{side} px, threads: {n}" for side in SIDES_PX for n in cores)]]
    rows += [[name, *(f"{s:.2f} s" for s in found.values())] for name, found in result["seconds"].items()]
    text = "\n".join(["# Rendering a frame", "", provenance_line(result), "", *table(rows), ""])
    write_result("rendering", result, text)


def measure(subject: Path, cores: list[int]) -> dict[str, float]:
    """Return the median seconds, by longest side and number of threads."""
    avatar, capture = avatar_of(subject), recording_of(subject)
    camera = capture.cameras[(*capture.test_cameras, *capture.train_cameras)[0]]
    found = {}
    for side_px in SIDES_PX:
        for threads in cores:
            torch.set_num_threads(threads)
            found[f"{side_px} px, {threads}"] = frame_seconds(avatar, camera, capture.train_frames[0], side_px)
    return found


if __name__ == "__main__":
    main()
