from pathlib import Path

import fsspec
import pytest

from hnerf.errors import InputError
from tasks.remote import fetched, remote_capture, remote_captures
from tasks.store import Store


@pytest.fixture(params=["file", "s3"])
def captures(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """URL of a folder with the captures ada and bob, and what does not belong to any."""
    if request.param == "file":
        url = f"file://{tmp_path}/captures"
    else:
        url = f"{request.getfixturevalue('s3')}-{tmp_path.name}"
    for name in ("ada/intri.yml", "ada/images/01/0.jpg", "bob/a.mp4", "bob/.hidden", "ada/.part/0.jpg", "note.txt"):
        write(f"{url}/{name}", name)
    return url


def write(url: str, text: str) -> None:
    with fsspec.open(url, "w", auto_mkdir=True) as file:
        file.write(text)


def test_captures_are_the_folders_and_their_files_are_fetched_once(captures: str, tmp_path: Path) -> None:
    ada, bob = remote_captures(captures)
    assert [(one.url, [file.name for file in one.files]) for one in (ada, bob)] == [
        (f"{captures}/ada", ["images/01/0.jpg", "intri.yml"]),
        (f"{captures}/bob", ["a.mp4"]),
    ]
    store = Store(tmp_path / "store")
    folder = fetched(store, ada)
    assert folder.name == "ada"
    found = {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}
    assert found == {"intri.yml": "ada/intri.yml", "images/01/0.jpg": "ada/images/01/0.jpg"}
    inode = folder.stat().st_ino
    assert fetched(store, remote_capture(f"{captures}/ada/")).stat().st_ino == inode


def test_what_changes_is_another_capture_and_is_not_fetched_as_the_first(captures: str, tmp_path: Path) -> None:
    before = remote_capture(f"{captures}/bob")
    write(f"{captures}/bob/a.mp4", "another, longer")
    after = remote_capture(f"{captures}/bob")
    assert after.digest != before.digest
    assert after.changed_s >= before.changed_s > 1.7e9
    with pytest.raises(InputError, match="bob: has changed since it was listed; give the same command again"):
        fetched(Store(tmp_path / "store"), before)
    assert (fetched(Store(tmp_path / "store"), after) / "a.mp4").read_text() == "another, longer"


def test_where_nothing_is_there_is_no_capture(captures: str) -> None:
    with pytest.raises(InputError, match=r"nobody: (no such folder|.* is not there)"):
        remote_capture(f"{captures}/nobody")


def test_a_name_never_leads_out_of_the_store(captures: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ada = remote_capture(f"{captures}/ada")
    out = ada.files[0].named("images/../../../out.jpg")
    monkeypatch.setattr("tasks.bucket.Bucket.files", lambda *_: iter([out]))
    with pytest.raises(InputError, match=r"'images/\.\./\.\./\.\./out\.jpg' cannot be the name of a file; rename it"):
        fetched(Store(tmp_path / "store"), remote_capture(f"{captures}/ada"))
    assert not list(tmp_path.rglob("out.jpg"))
    assert [path.suffix for path in (tmp_path / "store" / "fetched").iterdir()] == [".lock"]
