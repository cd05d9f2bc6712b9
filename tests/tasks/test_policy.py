import errno
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from prefect.states import Failed

from hnerf.config import (
    CaptureSettings,
    DetectionSettings,
    EvaluationSettings,
    FitSettings,
    Section,
    SegmentationSettings,
    TrainingSettings,
)
from hnerf.errors import InputError
from tasks.bucket import VARIABLE
from tasks.launcher import LostWorkerError
from tasks.policy import StorePolicy, is_transient, stage_key
from tasks.source import Source
from tasks.store import Artifact, StoredFile


def artifact(digit: str = "a", root: str = "/store/fit/k") -> Artifact:
    return Artifact(stage="fit", root=Path(root), files={"f": StoredFile(sha256=64 * digit, size_bytes=1)}, metrics={})


def source(digest: str = "d", name: str = "ada", root: str = "/here/ada") -> Source:
    return Source(root=Path(root), name=name, digest=digest)


def key(task: str = "fit", version: str = "1", **changed: Any) -> str:
    inputs: dict[str, Any] = {"source": source(), "body": artifact(), "settings": CaptureSettings(), "rough": None}
    return stage_key(task, version, inputs | {"several": (artifact(), artifact("b"))} | changed)


@pytest.mark.parametrize("read", [Mock(), Mock(side_effect=ValueError("Path ... does not exist."))])
def test_a_stale_record_may_be_dropped_by_another_run_first(
    read: Mock, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Here it is gone when this run removes it, or already when it reads it."""
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr("tasks.policy.PREFECT_RESULTS_LOCAL_STORAGE_PATH", Mock(value=lambda: tmp_path))
    context, store = Mock(), Mock(root=tmp_path)
    context.task.name, context.task.version = "fit", "1"
    context.result_store.exists.return_value, context.result_store.read = True, read
    record = StorePolicy().compute_key(context, {"store": store, "inputs": {"source": source()}}, {})
    assert record is not None and record.startswith("fit-")


@pytest.mark.parametrize(
    "same",
    [
        {"source": source(root="/there/ada")},
        {"body": artifact(root="/other/store/fit/k").model_copy(update={"metrics": {"seconds": 2.0}})},
        {"settings": CaptureSettings(max_side_px=CaptureSettings().max_side_px)},
        {"several": (artifact(root="/other/store/fit/k"), artifact("b"))},
    ],
)
def test_key_does_not_depend_on_paths(same: dict[str, Any]) -> None:
    assert key(**same) == key()


@pytest.mark.parametrize(
    "other",
    [
        {"task": "training"},
        {"version": "2"},
        {"source": source(digest="e")},
        {"source": source(name="bob")},
        {"body": artifact("b")},
        {"settings": CaptureSettings(max_side_px=64)},
        {"rough": artifact()},
        {"held_out": ()},
        {"held_out": (artifact(),)},
    ],
)
def test_key_changes_with_name_version_bytes_and_settings(other: dict[str, Any]) -> None:
    assert key(**other) != key()


def test_settings_that_do_not_affect_the_result_do_not_count() -> None:
    """For example, a higher memory limit must not cause a new training."""
    for one, other in (
        (TrainingSettings(), TrainingSettings(memory_gib=8, processes=2)),
        (EvaluationSettings(), EvaluationSettings(holdout="each")),
        (SegmentationSettings(), SegmentationSettings(rounds=9, still_px=1)),
        (DetectionSettings(), DetectionSettings(hands="none")),
    ):
        assert key(settings=one) == key(settings=other) and one != other
    assert key(settings=TrainingSettings()) != key(settings=TrainingSettings(steps=2))


def test_the_folder_of_a_ground_truth_does_not_count() -> None:
    ada, bob = (source(name=name).model_copy(update={"is_truth": True}) for name in ("ada", "bob"))
    assert key(truth=ada) == key(truth=bob) != key(truth=bob.model_copy(update={"digest": "e"}))


def test_a_file_in_a_setting_counts_by_its_content(tmp_path: Path) -> None:
    for name, content in (("a.npz", b"one"), ("b.npz", b"one"), ("c.npz", b"two")):
        (tmp_path / name).write_bytes(content)
    a, b, c, absent = (key(settings=FitSettings(body_model=tmp_path / f"{name}.npz")) for name in "abcd")
    assert a == b and len({a, c, absent, key(settings=FitSettings())}) == 4


def test_external_weights_of_a_network_count_too(tmp_path: Path) -> None:
    def network(place: str, weights: str) -> SegmentationSettings:
        (tmp_path / place).mkdir()
        for name, content in (("seg.onnx", "graph"), ("seg.onnx.data", weights), ("other.onnx.data", place)):
            (tmp_path / place / name).write_text(content)
        return SegmentationSettings(model=tmp_path / place / "seg.onnx")

    one, same, other = network("a", "one"), network("b", "one"), network("c", "two")
    assert key(settings=one) == key(settings=same) != key(settings=other)


def test_swapped_inputs_have_another_key() -> None:
    assert key(body=artifact("a"), rough=artifact("b")) != key(body=artifact("b"), rough=artifact("a"))


class Shape(Section):
    width: int = 3


def test_key_equals_a_known_value() -> None:
    """The key is the first 32 digits of the SHA-256 of {"inputs": {"settings": {"width": 3}}, "task": "fit", "version":
    "1"}. If it changes, every existing store computes everything again."""
    assert stage_key("fit", "1", {"settings": Shape()}) == "b8a992a905319034c4fab500077a8ef6"


@pytest.mark.parametrize(
    ("error", "transient"),
    [
        (OSError(5, "Input/output error"), True),
        (TimeoutError("server"), True),
        (ConnectionResetError("peer"), True),
        (LostWorkerError("rank 1 was killed"), True),
        (MemoryError(), True),
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB."), True),
        (RuntimeError("CUDA error: out of memory"), True),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes."), True),
        (RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`"), True),
        (RuntimeError("Failed to allocate 8 bytes on device 'cuda:0'"), True),
        (RuntimeError("Traceback (most recent call last):\nKeyError: 'out of memory'"), False),
        (RuntimeError("bug"), False),
        (FileNotFoundError("a.jpg"), False),
        (PermissionError("a.jpg"), False),
        (IsADirectoryError("a.jpg"), False),
        (OSError(errno.ENOSPC, "No space left on device"), True),
        (OSError(errno.EROFS, "Read-only file system"), False),
        (OSError(errno.ENAMETOOLONG, "File name too long"), False),
        (OSError(errno.ELOOP, "Too many levels of symbolic links"), False),
        (OSError(errno.ENOTEMPTY, "Directory not empty"), False),
        (InputError("a.jpg: bad"), False),
        (ValueError("bug"), False),
    ],
)
def test_only_transient_faults_are_retried(error: Exception, transient: bool) -> None:
    assert is_transient(None, None, Failed(data=error)) is transient
