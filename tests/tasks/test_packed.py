from contextlib import nullcontext
from pathlib import Path

import pytest

from hnerf.errors import InputError
from tasks.packed import ArchivedArtifact, Contents, archived, manifest_name, pack, place, read_contents, unpack
from tasks.store import Store
from tests.tasks.stores import add

# SHA-256 of b"abc" (FIPS 180-2, example B.1).
ABC = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


@pytest.fixture
def packed(tmp_path: Path) -> Path:
    """Return an archive of an artifact."""
    store = Store(tmp_path / "from")
    pack(Contents(artifacts=archived([add(store, "fit", 7)])), store, tmp_path / "packed")
    return tmp_path / "packed"


def test_a_manifest_is_named_by_its_digest() -> None:
    assert manifest_name(b"abc") == f"{ABC}.json"


def test_an_artifact_is_the_same_after_packing_and_unpacking(packed: Path, tmp_path: Path) -> None:
    before, store = Store(tmp_path / "from"), Store(tmp_path / "to")
    (tmp_path / "scratch").mkdir()
    (tmp_path / "to" / "fit").mkdir(parents=True)
    with packed.open("rb") as archive:
        contents = read_contents(Contents, archive, "packed")
        unpack(archive, contents, tmp_path / "scratch", "packed")
    ((name, one),) = contents.artifacts.items()
    placed = place(store, name, one, tmp_path / "scratch")
    assert contents.unpacked_bytes() == sum(contents.sizes_bytes().values()) == len("abc 7")
    assert placed.model_dump(exclude={"root"}) == before.recorded(*name.split("/")).model_dump(exclude={"root"})
    assert (placed.root / "deep" / "letters").read_text() == "abc 7"


def test_a_manifest_with_another_digest_is_refused(packed: Path) -> None:
    packed.write_bytes(packed.read_bytes().replace(b'"size_bytes":5', b'"size_bytes":6'))
    with packed.open("rb") as archive, pytest.raises(InputError, match="packed: its manifest is damaged"):
        read_contents(Contents, archive, "packed")


@pytest.mark.parametrize(("length", "fits"), [(255, True), (256, False)])
def test_names_too_long_for_file_systems_are_refused(length: int, fits: bool) -> None:
    stored = {"sha256": ABC, "size_bytes": 3}
    with nullcontext() if fits else pytest.raises(ValueError, match="is not a path inside a folder: too long"):
        ArchivedArtifact.model_validate({"files": {f"deep/{'a' * length}": stored}})
