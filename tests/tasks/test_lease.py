import os
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier, Event, Thread
from unittest.mock import Mock

import pytest

from tasks import lease
from tasks.bucket import Bucket, BucketError
from tasks.lease import FREE, leased

NAME = "fit/k"


@pytest.fixture
def bucket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bucket:
    """Return an empty bucket in which leases expire after 0.8 s."""
    for name, seconds in {"BEAT_S": 0.05, "EXPIRY_S": 0.8, "LOOK_S": 0.02}.items():
        monkeypatch.setattr(lease, name, seconds)
    return Bucket.at(f"file://{tmp_path}")


def notes(bucket: Bucket) -> list[str]:
    return sorted(Path(path).name for path in bucket.fs.glob(f"{bucket.root}/fit/*"))


def test_others_wait_for_an_owner_that_is_alive(bucket: Bucket) -> None:
    """The owner works for longer than a lease lasts if it is not renewed."""
    inside, order = Event(), list[str]()

    def own() -> None:
        with leased(bucket, NAME):
            inside.set()
            time.sleep(1.3)
            order.append("owner")

    owner = Thread(target=own)
    owner.start()
    inside.wait()
    with leased(bucket, NAME) as mine:
        order.append("waited")
        assert not mine
    owner.join()
    assert order == ["owner", "waited"]
    assert notes(bucket) == []


def test_the_owner_renews_its_lease(bucket: Bucket) -> None:
    seen = set()
    with leased(bucket, NAME):
        for _ in range(30):
            seen.add(bucket.read_note(f"{NAME}.lease.0"))
            time.sleep(0.02)
    assert len(seen - {b"", None}) > 2  # a file is empty while it is written


def test_a_waiting_process_notices_that_another_took_over(bucket: Bucket) -> None:
    """The first owner is silent, but a second one has taken over: now only its turn counts."""
    for turn in (0, 1):
        bucket.create_note(f"{NAME}.lease.{turn}", b"gone:1 5")
    assert not lease._expires(bucket, NAME, 0, b"gone:1 5")


def test_exactly_one_process_takes_over_from_a_dead_owner(bucket: Bucket) -> None:
    bucket.create_note(f"{NAME}.lease.0", b"gone:1 5")
    together, held = Barrier(8), list[float]()

    def take(_: int) -> bool:
        together.wait()
        with leased(bucket, NAME) as mine:
            if mine:
                held.append(time.monotonic())
                time.sleep(0.3)
        return mine

    began_s = time.monotonic()
    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(take, range(8))) == 1
    assert 0.8 <= held[0] - began_s < 2.0
    assert notes(bucket) == []


def test_a_dead_owner_is_replaced_at_once_on_its_own_machine(bucket: Bucket) -> None:
    """Its process id means nothing on another machine, after a reboot, or in another container."""
    gone = subprocess.Popen(["true"])
    gone.wait()
    host, place, _ = lease._text(0).decode().split()
    owner = f"{host.rpartition(':')[0]}:{gone.pid}"
    for where, least_s, most_s in ((place, 0.0, 0.4), (f"{place}0", 0.8, 2.0)):
        bucket.create_note(f"{NAME}.lease.0", f"{owner} {where} 5".encode())
        began_s = time.monotonic()
        with leased(bucket, NAME) as mine:
            assert mine and least_s <= time.monotonic() - began_s < most_s


def test_a_process_of_another_user_is_not_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even if /proc is mounted with hidepid, and does not show it."""
    gone = subprocess.Popen(["true"])
    gone.wait()
    text = f"host:{gone.pid} {lease._place()} 5".encode()
    assert lease._is_gone(text) and lease._is_gone(text.replace(b":", b":9999999999"))
    monkeypatch.setattr(os, "kill", Mock(side_effect=PermissionError))
    assert not lease._is_gone(text)


def test_released_work_can_be_taken_at_once(bucket: Bucket) -> None:
    with pytest.raises(KeyboardInterrupt), leased(bucket, NAME):
        raise KeyboardInterrupt
    assert bucket.read_note(f"{NAME}.lease.0") == FREE
    with leased(bucket, NAME) as mine:
        assert mine
        assert notes(bucket) == ["k.lease.0", "k.lease.1"]
    assert notes(bucket) == []


def test_partly_removed_turns_have_no_gap(bucket: Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    """Behind a gap in the turns, nobody would see the next owner, and two would work at once."""

    def remove_one(self: Bucket, name: str) -> None:
        monkeypatch.setattr(Bucket, "remove", Mock(side_effect=BucketError("away")))
        remove(self, name)

    with pytest.raises(KeyboardInterrupt), leased(bucket, NAME):
        raise KeyboardInterrupt
    remove = Bucket.remove
    monkeypatch.setattr(Bucket, "remove", remove_one)
    with leased(bucket, NAME):
        pass
    assert notes(bucket) == ["k.lease.0"]
