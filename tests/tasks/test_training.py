"""The training stage, with fake ranks."""

from pathlib import Path

import pytest

from hnerf.config import TrainingSettings
from hnerf.errors import InputError
from tasks import training as module
from tasks.store import Artifact, Store


def test_the_checkpoint_is_kept_until_training_ends_and_is_not_in_the_artifact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ranks(*arguments: object) -> None:
        out = Path(arguments[1][-1])
        found.append(sorted(path.name for path in out.iterdir()))
        for name in ("checkpoint.pt", "checkpoint.pt.tmp"):
            (out / name).write_bytes(b"state")
        (out / "report.json").write_text('{"steps": 1, "seconds": 2.0, "peak_memory_gib": 3.0, "model_mib": 4.0}')
        if len(found) == 1:
            raise OSError("lost")

    found: list[list[str]] = []
    monkeypatch.setattr(module, "run_ranks", ranks)
    given = Artifact(stage="capture", root=tmp_path, files={})
    with pytest.raises(OSError, match="lost"):
        module.train(Store(tmp_path), given, given, given, given, TrainingSettings())
    with monkeypatch.context() as one_gpu:  # a refused request keeps the checkpoint
        one_gpu.setattr("torch.cuda.device_count", lambda: 1)
        with pytest.raises(
            InputError, match=r"^training\.processes=2: each process needs a GPU, and this machine has 1;"
        ):
            module.train(Store(tmp_path), given, given, given, given, TrainingSettings(processes=2))
    made = module.train(Store(tmp_path), given, given, given, given, TrainingSettings())
    assert found == [[], ["checkpoint.pt", "checkpoint.pt.tmp", "report.json"]]
    assert list(made.files) == ["report.json"] == [path.name for path in made.root.iterdir()]
