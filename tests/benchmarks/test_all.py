"""Results are made once, in order, despite interruptions and failures; programs and checkouts are fake."""

import json
import os
import time
from pathlib import Path

import all as module
import pytest
from all import make
from freshness import load_records, save_record
from registry import Result

from tests.benchmarks.checkout import PROGRAM, Checkout, made

ONE, TWO = made("one"), made("two")
WAITS = "import time\nif name == 'slow' and not (Path(store) / 'go').exists():\n    time.sleep(60)\n"
MEETS = """
import time
began = time.monotonic()
while len((Path(store) / "calls").read_text().split()) < 2:
    assert time.monotonic() < began + 20, "alone"
    time.sleep(0.05)
"""


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Checkout:
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")  # or old bytecode runs within the same second
    monkeypatch.setattr(module, "POLL_S", 0.02)
    return Checkout(tmp_path)


def before_writing(checkout: Checkout, lines: str) -> None:
    """Make the program run these lines after it has recorded its call."""
    checkout.write("benchmarks/program.py", PROGRAM.replace("results =", f"{lines}\nresults ="))
    checkout.commit()


def test_stale_results_are_made_and_fresh_ones_skipped(checkout: Checkout, capsys: pytest.CaptureFixture[str]) -> None:
    assert make(checkout.root, [ONE, TWO], checkout.store, 1) == 0
    assert checkout.calls() == ["one", "two"]
    record = load_records(checkout.root)["one"]
    assert (len(record["digest"]), len(record["commit"]), list(record["files"])) == (64, 12, ["one.md"])
    assert record["machine"]["threads"] == 1
    assert record["seconds"] > 0
    assert record["load"] >= 0
    assert f"| one | {record['seconds']:.0f} | {record['commit']} |" in checkout.text("provenance")
    assert make(checkout.root, [ONE, TWO], checkout.store, 1) == 0
    assert checkout.calls() == ["one", "two"]
    assert capsys.readouterr().out.splitlines()[-2:] == ["one: fresh", "two: fresh"]


def test_changed_code_remakes_a_result_and_keeps_its_time_unless_the_store_is_new(checkout: Checkout) -> None:
    make(checkout.root, [ONE], checkout.store, 1)
    first = load_records(checkout.root)["one"]
    checkout.write("hnerf/far.py", "NUMBER = 2\n")
    checkout.commit()
    assert make(checkout.root, [ONE], checkout.store, 1) == 0
    second = load_records(checkout.root)["one"]
    assert checkout.text("one") == "2\n"
    assert second["commit"] != first["commit"]
    assert second["seconds"] == first["seconds"]  # the store was not new this time
    fresh_store = checkout.store.with_name("another")
    fresh_store.mkdir()
    checkout.write("hnerf/far.py", "NUMBER = 3\n")
    checkout.commit()
    assert make(checkout.root, [ONE], fresh_store, 1) == 0
    assert load_records(checkout.root)["one"]["seconds"] != first["seconds"]


@pytest.mark.parametrize("used", [True, False])
def test_no_time_is_recorded_if_a_training_in_the_store_was_used(checkout: Checkout, used: bool) -> None:
    """The store has a training that is an hour old; using it touches its record."""
    folder = checkout.store / "training" / "a"
    folder.mkdir(parents=True)
    folder.with_suffix(".json").touch()
    for path in (folder, folder.with_suffix(".json")):
        os.utime(path, (time.time() - 3600,) * 2)
    before_writing(checkout, "(Path(store) / 'training' / 'a.json').touch()" if used else "")
    assert make(checkout.root, [ONE], checkout.store, 1) == 0
    assert (load_records(checkout.root)["one"]["seconds"] is None) == used


def test_a_checkout_with_changes_is_refused(checkout: Checkout) -> None:
    checkout.write("hnerf/far.py", "NUMBER = 2\n")
    with pytest.raises(SystemExit, match=r"^2$"):
        make(checkout.root, [ONE], checkout.store, 1)
    assert checkout.calls() == []


def test_an_interrupted_run_resumes_where_it_stopped(checkout: Checkout, monkeypatch: pytest.MonkeyPatch) -> None:
    before_writing(checkout, WAITS)
    slow, sleep = made("slow"), time.sleep

    def interrupt(seconds: float) -> None:
        if "slow" in checkout.calls():
            raise KeyboardInterrupt
        sleep(seconds)

    monkeypatch.setattr(module.time, "sleep", interrupt)
    with pytest.raises(KeyboardInterrupt):
        make(checkout.root, [ONE, slow, TWO], checkout.store, 1)
    assert checkout.calls() == ["one", "slow"]
    assert list(load_records(checkout.root)) == ["one"]
    spent_s = json.loads((checkout.store / "logs" / "slow.json").read_text())["seconds"]
    monkeypatch.setattr(module.time, "sleep", sleep)
    (checkout.store / "go").touch()
    assert make(checkout.root, [ONE, slow, TWO], checkout.store, 1) == 0
    assert checkout.calls() == ["one", "slow", "slow", "two"]
    assert load_records(checkout.root)["slow"]["seconds"] > spent_s


def test_a_failure_is_reported_at_the_end_and_others_continue(
    checkout: Checkout, capsys: pytest.CaptureFixture[str]
) -> None:
    before_writing(checkout, "if name == 'bad':\n    print('broken', file=sys.stderr)\n    sys.exit(3)")
    assert make(checkout.root, [made("bad"), ONE], checkout.store, 1) == 1
    assert checkout.calls() == ["bad", "one"]
    assert list(load_records(checkout.root)) == ["one"]
    assert capsys.readouterr().err.startswith("failed: bad: exit code 3: broken (")


def test_code_that_changes_while_it_runs_gives_no_result(
    checkout: Checkout, capsys: pytest.CaptureFixture[str]
) -> None:
    before_writing(checkout, "Path('hnerf/far.py').write_text('NUMBER = 4')")
    assert make(checkout.root, [ONE], checkout.store, 1) == 1
    assert load_records(checkout.root) == {}
    assert "its code was changed while it ran" in capsys.readouterr().err


def test_files_no_longer_written_are_removed_and_writing_none_is_a_failure(
    checkout: Checkout, capsys: pytest.CaptureFixture[str]
) -> None:
    checkout.write("benchmarks/results/one-old.md", "1")
    both = Result("one", ONE.command, ("one.md", "one-*.md"))
    assert make(checkout.root, [both], checkout.store, 1) == 0
    assert list(load_records(checkout.root)["one"]["files"]) == ["one.md"]
    assert not (checkout.root / "benchmarks" / "results" / "one-old.md").exists()
    nothing = Result("nothing", ("program.py", "else", "{store}"), ("nothing.md",))
    assert make(checkout.root, [nothing], checkout.store, 1) == 1
    assert "wrote no file named nothing.md" in capsys.readouterr().err


def test_results_that_lack_captures_or_cores_are_left_out(
    checkout: Checkout, capsys: pytest.CaptureFixture[str]
) -> None:
    far, wide = made("far", captures=("absent",)), made("wide", threads=2)
    assert make(checkout.root, [far, wide], checkout.store, 1) == 0
    assert checkout.calls() == []
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["far: left out: no ../shared/data/absent", "wide: left out: needs both cores; give --jobs 2"]
    (checkout.root.parent / "shared" / "data" / "absent").mkdir(parents=True)
    assert make(checkout.root, [far, wide], checkout.store, 2) == 0
    assert checkout.calls() == ["far", "wide"]


def test_two_jobs_run_in_parallel(checkout: Checkout) -> None:
    before_writing(checkout, MEETS)
    assert make(checkout.root, [ONE, TWO], checkout.store, 2) == 0


def test_the_argument_new_is_a_folder_for_this_result_and_code(checkout: Checkout) -> None:
    before_writing(checkout, "(Path(store) / 'kept').touch()")
    timed = Result("a/b", ("program.py", "b", "{new}"), ("b.md",))
    assert make(checkout.root, [timed], checkout.store, 1) == 0
    digest = load_records(checkout.root)["a/b"]["digest"]
    assert (checkout.store / f"a-b-{digest[:12]}" / "kept").exists()


def test_the_list_shows_which_results_are_fresh_and_why_others_are_not(checkout: Checkout) -> None:
    make(checkout.root, [ONE], checkout.store, 1)
    record = load_records(checkout.root)["one"]
    lines = module.listing(checkout.root, [ONE, TWO])
    known = f"{record['seconds']:.0f} | {record['digest'][:12]} | {record['commit']}"
    assert lines[2] == f"| one | fresh | - | {known} |"
    assert lines[3] == "| two | stale: not recorded | - | - | - | - |"


def test_the_list_shows_the_stages_that_have_had_their_version_raised(checkout: Checkout) -> None:
    """Other changes of the code leave what a stage yields as it was."""
    checkout.write("hnerf/far.py", "def work():\n    from tasks import fit\n\n\nNUMBER = 1\n")
    stages = '@stage("fit", version="9")\ndef fit():\n    pass\n\n\n@stage("hands", version="3", networks=())\n'
    checkout.write("tasks/fit.py", f"{stages}def hands():\n    pass\n")
    checkout.write("tasks/unused.py", '@stage("unused", version="1")\ndef unused():\n    pass\n')
    checkout.commit()
    make(checkout.root, [ONE], checkout.store, 1)
    assert " | none | " in module.listing(checkout.root, [ONE])[2]
    for path in (checkout.root / "tasks").iterdir():
        path.write_text(path.read_text().replace("9", "10").replace('"1"', '"2"'))
    checkout.commit()
    assert "| one | stale: its code has changed | fit 9 → 10 | " in module.listing(checkout.root, [ONE])[2]
    save_record(checkout.root, "one", load_records(checkout.root)["one"] | {"commit": "0123456789ab"})
    assert " | unknown | " in module.listing(checkout.root, [ONE])[2]


def test_an_unknown_name_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match=r"^2$"):
        module.main(["nonsense"])
    assert "nonsense: no such result" in capsys.readouterr().err
