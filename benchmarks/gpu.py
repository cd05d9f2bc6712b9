"""Train, evaluate and render a prepared subject on a GPU.

usage: python benchmarks/gpu.py SUBJECT CAPTURE OUT [--preset NAME] [--set a.b=c]

SUBJECT is a folder of a store's `subjects/`, whose recording, calibration, masks and body fit were made on any machine;
CAPTURE the recording as it came, for its `ground_truth/`. Training and evaluation are those of the pipeline's stages,
without Prefect. Writes `OUT/training/`, `OUT/evaluation/` and, under `benchmarks/results/`, `gpu-PRESET-SUBJECT.json`
and `.md`.
"""

from pathlib import Path

import torch
from provenance import arguments, provenance, provenance_line, table, write_result
from score_shared import GEOMETRY_COLUMNS, IMAGE_COLUMNS, score_cells

from hnerf.avatar.finished import recording_of
from hnerf.avatar.trained import load_avatar
from hnerf.body.fit_result import BodyFit
from hnerf.capture.masks import Masks
from hnerf.config import load_settings
from hnerf.evaluation.evaluate import evaluate
from hnerf.evaluation.inputs import EvaluationInputs
from hnerf.study.benchmark.scoring import frame_seconds
from hnerf.training.trainer import train

SIDES_PX = (256, 512)


def main() -> None:
    """Train, evaluate, render and write."""
    parser = arguments(__doc__)
    for name in ("subject", "capture", "out"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="a.b=c")
    options = parser.parse_args()
    result = provenance() | {"preset": options.preset, "overrides": options.overrides}
    settings = load_settings(options.preset, options.overrides)
    folders = {name: options.subject / name for name in ("calibration", "segmentation", "fit")}
    capture = recording_of(options.subject)
    masks, body = Masks.load(folders["segmentation"]), BodyFit.load(folders["fit"])
    training, evaluation = options.out / "training", options.out / "evaluation"
    for folder in (training, evaluation):
        folder.mkdir(parents=True, exist_ok=True)
    result["training"] = train(capture, masks, body, settings.training, training)
    avatar = load_avatar(training, "cuda")
    camera = capture.cameras[(*capture.test_cameras, *capture.train_cameras)[0]]
    frame = capture.train_frames[0]
    result["frame_seconds"] = {str(side): frame_seconds(avatar, camera, frame, side) for side in SIDES_PX}
    result["peak_memory_gib"] = torch.cuda.max_memory_allocated() / 2**30
    inputs = {f"{name}_folder": folder for name, folder in folders.items()} | {"training_folder": training}
    result["metrics"] = evaluate(
        EvaluationInputs(options.capture, capture, masks, body, avatar, **inputs), settings.evaluation, evaluation
    )
    name = f"gpu-{options.preset}-{options.subject.name}"
    write_result(name, result, as_markdown(options.subject.name, result))


def as_markdown(subject: str, result: dict) -> str:
    """Format the scores of each split, and the cost."""
    changes = f" with {', '.join(result['overrides'])}" if result["overrides"] else ""
    rows = [["", "images", *(title for title, _ in (IMAGE_COLUMNS | GEOMETRY_COLUMNS).values())]]
    for split, title in (("novel_view", "training poses, test cameras"), ("novel_pose", "new poses, animated")):
        rows.append([title, *score_cells(result["metrics"][split])])
    training, seconds = result["training"], result["frame_seconds"]
    cost = {
        "setup, s": f"{training['setup_seconds']:.0f}",
        "training, s": f"{training['seconds']:.0f}",
        "of that the field, s": f"{training['field_seconds']:.0f}",
        "steps": str(training["steps"]),
        "GPU memory, GiB": f"{result['peak_memory_gib']:.1f}",
    }
    cost |= {f"a frame at {side} px, s": f"{seconds[str(side)]:.3f}" for side in SIDES_PX}
    head = [f"# {subject} on a GPU, preset `{result['preset']}`{changes}", "", provenance_line(result), ""]
    protocol = ["", "## Protocol", "", result["metrics"]["protocol"], ""]
    return "\n".join([*head, *table(rows), "", *table([list(cost), list(cost.values())]), *protocol])


if __name__ == "__main__":
    main()
