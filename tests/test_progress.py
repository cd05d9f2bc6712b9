import logging

import pytest

from hnerf import progress


@pytest.fixture
def reported(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    caplog.set_level(logging.DEBUG, progress.log.name)
    return caplog


def test_progress_is_reported_before_each_item_and_at_the_end(reported: pytest.LogCaptureFixture) -> None:
    assert list(progress.tracked("ab", "letters", 2)) == ["a", "b"]
    assert [record.progress for record in reported.records] == [("letters", done, 2) for done in (0, 1, 2)]


def test_failed_work_is_reported_as_ended(reported: pytest.LogCaptureFixture) -> None:
    items = progress.tracked("abc", "letters", 3)
    next(items)
    with pytest.raises(ValueError, match="broken"):
        items.throw(ValueError("broken"))
    assert [record.progress.done for record in reported.records] == [0, 3]


def test_progress_of_another_process_is_relayed(
    reported: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "_listeners", [])
    progress.relay()
    for done in (1.5, 2, 4):  # the second within half a second of the first
        progress.report("training", done, 4)
    progress._listeners.clear()
    reported.clear()
    *lines, end = capsys.readouterr().out.split("\n")
    assert [progress.report_relayed(line) for line in (*lines, end, "step 1 of 4")] == [True, True, False, False]
    assert [record.progress for record in reported.records] == [("training", 1.5, 4), ("training", 4, 4)]


def test_text_of_another_process_on_the_line_is_dropped(reported: pytest.LogCaptureFixture) -> None:
    assert progress.report_relayed(progress.RECORD_SEPARATOR + '["training", 1, 4]INFO: created')
    assert [record.progress for record in reported.records] == [("training", 1, 4)]


@pytest.mark.parametrize("rest", ["", "OSError: no room", '["training", 2, 4]'])
def test_progress_that_is_cut_short_is_dropped(rest: str, reported: pytest.LogCaptureFixture) -> None:
    """A full disk takes part of a line; the error of the process itself says so."""
    assert progress.report_relayed(f'{progress.RECORD_SEPARATOR}["training", 1{rest}')
    assert reported.records == []


def test_the_seconds_of_a_step_are_logged_and_stored(
    reported: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress.time, "perf_counter", iter((1.0, 3.25)).__next__)
    seconds = {"mesh": 1.0}
    with progress.timed("texture", seconds, progress.log):
        pass
    assert seconds == {"mesh": 1.0, "texture": 2.25}
    assert reported.messages == ["texture: 2.2 s"]
