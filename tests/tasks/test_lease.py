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


def test_one_who_lives_is_waited_for(bucket: Bucket) -> None:
    """The owner works for longer than a lease that nobody renews lasts."""
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


def test_the_owner_keeps_showing_that_it_lives(bucket: Bucket) -> None:
    seen = set()
    with leased(bucket, NAME):
        for _ in range(30):
            seen.add(bucket.read_note(f"{NAME}.lease.0"))
            time.sleep(0.02)
    assert len(seen - {b"", None}) > 2  # a file is empty while it is written


def test_who_waits_sees_that_another_took_over(bucket: Bucket) -> None:
    """The first owner is silent, but it is the second one's turn that counts now."""
    for turn in (0, 1):
        bucket.create_note(f"{NAME}.lease.{turn}", b"gone:1 5")
    assert not lease._expires(bucket, NAME, 0, b"gone:1 5")


def test_of_many_one_takes_over_from_one_who_died(bucket: Bucket) -> None:
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


def test_a_process_that_is_gone_is_not_waited_for_where_it_ran(bucket: Bucket) -> None:
    """Its number says nothing of another machine, another start of this one, or another container."""
    gone = subprocess.Popen(["true"])
    gone.wait()
    host, place, _ = lease._text(0).decode().split()
    owner = f"{host.rpartition(':')[0]}:{gone.pid}"
    for where, least_s, most_s in ((place, 0.0, 0.4), (f"{place}0", 0.8, 2.0)):
        bucket.create_note(f"{NAME}.lease.0", f"{owner} {where} 5".encode())
        began_s = time.monotonic()
        with leased(bucket, NAME) as mine:
            assert mine and least_s <= time.monotonic() - began_s < most_s


def test_given_up_work_can_be_taken_at_once(bucket: Bucket) -> None:
    with pytest.raises(KeyboardInterrupt), leased(bucket, NAME):
        raise KeyboardInterrupt
    assert bucket.read_note(f"{NAME}.lease.0") == FREE
    with leased(bucket, NAME) as mine:
        assert mine
        assert notes(bucket) == ["k.lease.0", "k.lease.1"]
    assert notes(bucket) == []


def test_turns_that_are_only_partly_removed_have_no_gap(bucket: Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    """Behind a gap, nobody would see the next owner, and two would work at once."""

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
