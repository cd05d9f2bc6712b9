"""Run a study of speed and accuracy, stability or ablations on a capture, and keep its tables and charts.

usage: python benchmarks/studies.py STORE CAPTURE benchmark|stability STUDY [--methods a,b] [--seconds S]
       python benchmarks/studies.py STORE CAPTURE ablations PRESET [--methods no-opt,no-noise] [--set a.b=c]

CAPTURE is the name of a shared capture, a folder, or `performer`, which stands for a synthetic capture with the
settings `--synth`, written to STORE.

Runs `hnerf benchmark`, `hnerf stability` or `hnerf ablate` with STORE, where finished work is reused, and
copies its tables and charts to `benchmarks/results/<kind>/`, without the `-part` of a study with other methods or
seconds. Ablations are scored on a few images.
"""

import shutil
from importlib import import_module
from pathlib import Path

from provenance import RESULTS, ROOT, SHARED, arguments, clean_commit, provenance, provenance_line

from hnerf.config import SyntheticSettings, overridden
from hnerf.files import atomic_folder, markdown_image
from hnerf.synthetic import write_synthetic_capture

FEW = ["evaluation.max_images=8", "evaluation.max_meshes=2", "evaluation.report_rows=1"]


def main() -> None:
    """Run one study, copy its files and add their provenance."""
    parser = arguments(__doc__)
    parser.add_argument("store", type=Path)
    parser.add_argument("capture")
    parser.add_argument("kind", choices=["benchmark", "stability", "ablations"])
    parser.add_argument("study")
    parser.add_argument("--methods", default="")
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="a.b=c", help="of ablations")
    parser.add_argument("--synth", action="append", default=[], metavar="a=b", help="of the performer")
    options = parser.parse_args()
    folder = capture_folder(options.capture, options.synth, options.store)
    methods = [name for name in options.methods.split(",") if name]
    where = provenance_line(provenance())
    flow = import_module(f"flows.{options.kind}")  # the others are no part of what the registry says this result runs
    if options.kind == "benchmark":
        table = flow.benchmark.fn(folder, options.study, methods, options.seconds, options.store)
    elif options.kind == "ablations":
        table = flow.ablate.fn(folder, options.study, options.store, [*FEW, *options.overrides], methods)
    else:
        table = flow.stability.fn(folder, options.study, options.store, methods)
    clean_commit(ROOT)  # refuse if the checkout has changed during the study
    kept = RESULTS / options.kind
    kept.mkdir(parents=True, exist_ok=True)
    name = table.stem if options.kind == "ablations" else table.stem.removesuffix("-part")
    made = table.read_text()
    for path in [*table.parent.glob(f"{table.stem}.*"), *table.parent.glob(f"{table.stem}-*.png")]:
        if path.suffix == ".recording" or (path.suffix == ".png" and markdown_image(path.name) not in made):
            continue  # says which folder was studied, or is a chart of another study, like dynamic-converged
        shutil.copy(path, kept / path.name.replace(table.stem, name))
    text = f"{made.replace(table.stem, name)}\nMade by `benchmarks/studies.py`: {where}\n"
    (kept / f"{name}.md").write_text(text)
    print(text)


def capture_folder(name: str, synth: list[str], store: Path) -> Path:
    """Return the folder of a capture; the performer's capture is written first."""
    if name != "performer":
        shared = SHARED / "data" / name
        return shared if shared.is_dir() else Path(name)
    folder = store / "synthetic" / ",".join(["performer", *synth])
    shutil.rmtree(folder, ignore_errors=True)  # it may have been written by other code
    with atomic_folder(folder) as partial:
        write_synthetic_capture(partial, overridden(SyntheticSettings(), synth))
    return folder


if __name__ == "__main__":
    main()
