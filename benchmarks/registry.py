"""Registry of the committed results: which program makes each, and what it needs."""

from dataclasses import dataclass

CALIBRATED = ("valid-walk", "valid-wave")
RENDERED = (*CALIBRATED, "valid-turn-mono")
FEW = ("evaluation.max_images=12", "evaluation.max_meshes=3")  # per split, since each takes a quarter of a minute

PAPERS_ROWS = ("mask", "blend", "geometry", "segmentation", "eikonal", "residual", "opt", "root", "noise")
SMALL = "size_px=128"  # for many images by NeRF, which takes 18 s for each at 256 px
MOMENT = (SMALL, "train_frames=1", "novel_pose_frames=0")
LARGE = tuple(
    f"--synth={setting}"
    for setting in ("size_px=1024", "train_cameras=8", "test_cameras=1", "train_frames=200", "novel_pose_frames=8")
)
LONG_WALK = ("train_frames=40", "novel_pose_frames=24")


@dataclass(frozen=True)
class Result:
    """A result: files with a common name under benchmarks/results/.

    command: a program under benchmarks/ and its arguments. In these, {store} is the store of all results; {new} is a
    folder that no other result and no other version of the code uses, for programs that time all of their work. files:
    patterns under benchmarks/results/; captures: names under ../shared/data; configs: patterns under configs/ without
    ".yaml"; runs: modules that the program starts, or imports by a computed name; threads: used by the program; gpu:
    whether it needs one.
    """

    name: str
    command: tuple[str, ...]
    files: tuple[str, ...]
    captures: tuple[str, ...] = ()
    configs: tuple[str, ...] = ()
    runs: tuple[str, ...] = ()
    threads: int = 1
    gpu: bool = False


def measured(
    name: str, *command: str, captures: tuple[str, ...] = (), configs: tuple[str, ...] = (), threads: int = 1
) -> Result:
    """Return a result that has a JSON file, a table and, in some cases, a chart."""
    return Result(name, command, (f"{name}.*",), captures, configs, threads=threads)


def shared(
    name: str, capture: str, preset: str = "fast", *changes: str, without: tuple[str, ...] = (), threads: int = 1
) -> Result:
    """Return a timed result of the whole pipeline on one capture. without: names of folders that are removed from the
    capture."""
    command: tuple[str, ...] = ("score_shared.py", capture, "--preset", preset, "--store", "{new}", "--name", name)
    command += tuple(f"--set={change}" for change in changes)
    command += ("--without", *without) if without else ()
    return Result(name, command, (f"{name}.*",), (capture,), (preset,), ("flows.train_subject",), threads)


def on_gpu(capture: str, preset: str, *changes: str) -> Result:
    """Return a result of training and evaluation on a GPU, for a subject whose stages up to the body fit are in the
    store."""
    name = f"gpu-{preset}-{capture}"
    captured = f"{{store}}/subjects/{capture}", f"../shared/data/{capture}"
    command = ("gpu.py", *captured, "{new}", "--preset", preset, *(f"--set={change}" for change in changes))
    return Result(name, command, (f"{name}.*",), (capture,), (preset,), gpu=True)


def study(
    kind: str,
    name: str,
    *methods: str,
    seconds: int | None = None,
    synth: tuple[str, ...] = (),
    store: str = "{store}",
    threads: int = 1,
) -> Result:
    """Return a benchmark or stability study of valid-wave, or of the synthetic performer in a capture with settings
    `synth`. seconds: of each training, instead of the study's."""
    capture = "performer" if synth else "valid-wave"
    title = f"{kind}/{capture}-{name}"
    command: tuple[str, ...] = ("studies.py", store, capture, kind, name, "--methods", ",".join(methods))
    command += (f"--seconds={seconds}",) if seconds else ()
    command += tuple(f"--synth={setting}" for setting in synth)
    captures = () if synth else (capture,)
    files = (f"{title}.*", f"{title}-*.png")
    runs = (f"flows.{kind}",)
    return Result(title, command, files, captures, (f"{kind}/{name}", *methods), runs, threads)


def ablations(preset: str, *changes: str, rows: tuple[str, ...] = ()) -> Result:
    """Return a study on valid-wave of the method without each of its parts, or only without the parts that `rows`
    names."""
    command: tuple[str, ...] = ("studies.py", "{store}", "valid-wave", "ablations", preset)
    command += tuple(f"--set={change}" for change in changes)
    command += ("--methods", ",".join(f"no-{row}" for row in rows)) if rows else ()
    title = f"ablations/valid-wave-{preset}{'-part' if rows else ''}"
    configs = (preset, "ablations/*")
    return Result(title, command, (f"{title}.*",), ("valid-wave",), configs, ("flows.ablations",))


REGISTRY = (
    measured("descriptor", "descriptor.py"),
    measured("boards", "boards.py", captures=("caliscope-charuco",)),
    measured("calibration-faults", "calibration.py", captures=CALIBRATED),
    measured("person-calibration", "person_calibration.py", captures=("pose2sim-balance", *CALIBRATED)),
    measured("detection", "detection.py", captures=("pose2sim-balance", *CALIBRATED), threads=2),
    measured("segmentation", "segmentation.py", captures=RENDERED),
    measured("fit", "fit.py", "{store}", captures=RENDERED, configs=("fast",)),
    measured("limits", "limits.py", "{store}", captures=CALIBRATED, configs=("fast",)),
    shared("shared-fast-wave", "valid-wave"),
    shared("shared-fast-walk", "valid-walk"),
    *(shared(f"shared-video-{name}", f"valid-{name}", without=("openpose", "background")) for name in ("wave", "walk")),
    shared("shared-fast-one-camera", "valid-turn-mono"),
    shared("shared-fast-real", "pose2sim-balance"),
    shared("shared-paper-small-wave", "valid-wave", "paper-small", *FEW),
    measured("scaling", "scaling.py", "scaling", "valid-wave", captures=("valid-wave",), configs=("fast",)),
    measured("scaling-large", "scaling.py", "scaling-large", "performer", *LARGE, configs=("fast",)),
    measured("pixels-memory", "pixels_memory.py"),
    study("stability", "quick", "fast"),
    study("stability", "fast", "fast"),
    study("stability", "published", "fast", "neural-body"),
    ablations("fast", "evaluation.max_images=48"),
    ablations(
        "paper-small", "training.steps=200", "capture.max_side_px=128", "evaluation.max_images=4", rows=PAPERS_ROWS
    ),
    study("benchmark", "static", "fast", "paper-small", "nerf", "idr", seconds=900),
    study("benchmark", "dynamic", "fast", "neural-body", "nerfies", seconds=3600),
    study("benchmark", "frames", "fast", "neural-body", seconds=120),
    study("benchmark", "monocular", "fast"),
    study("benchmark", "nerfies", "fast", "nerfies", seconds=240),
    *(
        study("benchmark", name, "fast", "nerf", "idr", seconds=90, synth=(*MOMENT, *cameras))
        for name, cameras in (
            ("cameras", ("train_cameras=32", "test_cameras=8")),
            ("view-angle", ("train_cameras=64", "test_cameras=64")),
        )
    ),
    study("benchmark", "pose-distance", "fast", "neural-body", seconds=120, synth=(SMALL, *LONG_WALK)),
    measured("budget", "budget.py", "{store}", "{new}", captures=RENDERED, configs=("fast",)),
    on_gpu("valid-wave", "fast", "evaluation.max_images=40"),
    on_gpu("valid-walk", "fast-gpu", "evaluation.max_images=12", "evaluation.max_meshes=2"),
    on_gpu(
        *("valid-walk", "paper", "evaluation.max_images=6", "evaluation.max_meshes=2"),
        *("training.novel_pose_steps=0", "training.seconds=640"),
    ),
    shared("shared-fast-two-threads", "valid-wave", threads=2),
    shared("shared-fast-300-steps", "valid-wave", "fast", "training.steps=300", threads=2),
    measured("soak", "soak.py", configs=("demo",), threads=2),
    measured("rendering", "rendering.py", "{store}", captures=RENDERED, configs=("fast",), threads=2),
    study("benchmark", "quick", "fast", "paper-small", "nerf", store="{new}", threads=2),
)
