from pathlib import Path
from typing import Any

import pytest
from fsspec import filesystem

from hnerf.errors import InputError
from tasks.bucket import VARIABLE, Bucket
from tasks.remote import fetched, remote_capture, remote_captures
from tasks.source import GoneError
from tasks.store import Store


@pytest.fixture
def captures(s3: str, tmp_path: Path) -> str:
    """Return the URL of a folder with the captures ada and bob, and objects that belong to no capture."""
    url = f"{s3}-{tmp_path.name}"
    for name in ("ada/intri.yml", "ada/images/01/0.jpg", "bob/a.mp4", "bob/.hidden", "ada/.part/0.jpg", "note.txt"):
        write(f"{url}/{name}", name)
    for marker in ("", "ada/", "ada/images/", "empty/", "/stray.txt", "ada//intri.yml", "ada/../up.txt"):
        write(f"{url}/{marker}", "")
    return url


def write(url: str, text: str) -> None:
    bucket, _, key = url.removeprefix("s3://").partition("/")
    filesystem("s3").call_s3("put_object", Bucket=bucket, Key=key, Body=text.encode())


def test_every_folder_is_a_capture_and_its_files_are_fetched_once(captures: str, tmp_path: Path) -> None:
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


def test_fetched_captures_are_not_uploaded_to_the_shared_bucket(
    captures: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "shared").mkdir()
    monkeypatch.setenv(VARIABLE, f"file://{tmp_path}/shared")
    fetched(Store(tmp_path / "store"), remote_capture(f"{captures}/ada"))
    assert not list((tmp_path / "shared").iterdir())


def test_changed_content_of_the_same_size_is_another_capture(captures: str, tmp_path: Path) -> None:
    before = remote_capture(f"{captures}/bob")
    write(f"{captures}/bob/a.mp4", "BOB/A.MP4")
    after = remote_capture(f"{captures}/bob")
    assert after.digest != before.digest
    with pytest.raises(InputError, match="bob: has changed since it was listed; give the same command again"):
        fetched(Store(tmp_path / "store"), before)
    assert (fetched(Store(tmp_path / "store"), after) / "a.mp4").read_text() == "BOB/A.MP4"


@pytest.mark.parametrize("change", ["replaced", "removed"])
def test_a_capture_that_changes_while_it_is_fetched_is_refused(
    captures: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    bob = remote_capture(f"{captures}/bob")
    download = Bucket.download

    def meanwhile(bucket: Bucket, *given: Any) -> None:
        if change == "removed":
            filesystem("s3").rm(f"{captures}/bob/a.mp4")
        else:
            write(f"{captures}/bob/a.mp4", "BOB/A.MP4")
        download(bucket, *given)

    monkeypatch.setattr(Bucket, "download", meanwhile)
    with pytest.raises(InputError, match=r"bob: (has changed since it was listed|no such folder)"):
        fetched(Store(tmp_path / "store"), bob)
    assert not list((tmp_path / "store" / "fetched").glob("*.json"))


@pytest.mark.parametrize("url", ["nobody", "ada/..", "bob/a.mp4", "ada?versionId=1", "empty"])
def test_a_url_without_a_folder_is_refused(captures: str, url: str) -> None:
    with pytest.raises(GoneError, match="no such folder; give the capture's folder"):
        remote_capture(f"{captures}/{url}")


def test_a_file_that_is_also_a_folder_is_refused(captures: str, tmp_path: Path) -> None:
    write(f"{captures}/ada/images", "a file")
    with pytest.raises(InputError, match=r"ada/images/01/0\.jpg: is both a file and a folder; rename one"):
        fetched(Store(tmp_path / "store"), remote_capture(f"{captures}/ada"))


@pytest.mark.parametrize("url", ["ftp://user:secret@host/captures/ada", "s3://tests/a::b"])
def test_ambiguous_urls_and_urls_with_a_password_are_refused(url: str) -> None:
    with pytest.raises(InputError, match=r"^a URL with a password or `::` is refused") as refused:
        remote_capture(url)
    assert "secret" not in str(refused.value)


def test_a_file_system_without_etags_is_refused(tmp_path: Path) -> None:
    filesystem("memory").pipe("/bare/ada/a.mp4", b"1")
    with pytest.raises(InputError, match="has no ETag; put captures into a bucket of S3"):
        list(remote_captures("memory://bare"))


def test_a_download_reports_its_progress(captures: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[str, float, float]] = []
    monkeypatch.setattr("tasks.bucket.report", lambda *given: seen.append(given))
    fetched(Store(tmp_path / "store"), remote_capture(f"{captures}/bob"))
    assert seen[-1] == ("a.mp4", 9, 9)
