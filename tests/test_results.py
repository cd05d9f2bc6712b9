"""Results as JSON files: invalid ones are refused, and the committed schemas match the code."""

import json
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import ValidationError

from hnerf.results.__main__ import main
from hnerf.results.files import FILES, write_result, write_schemas
from hnerf.results.scores import HeldOutCamera, Mean

SCHEMAS = Path(__file__).parent.parent / "docs" / "schemas"
MEANS: dict[str, Any] = dict.fromkeys(get_args(Mean))
NONE = {"n": 0, "per_image": []} | MEANS | {"reason": "no test camera"}
SCORES = {"camera": "a", "trained_on": ["b"], "novel_view": NONE, "novel_pose": NONE}


def test_a_valid_result_is_written_unchanged(tmp_path: Path) -> None:
    write_result(tmp_path / "holdout.json", HeldOutCamera, SCORES)
    assert (tmp_path / "holdout.json").read_text() == json.dumps(SCORES, indent=1)


@pytest.mark.parametrize(
    "wrong",
    [SCORES | {"psnr": 1.0}, SCORES | {"novel_pose": NONE | {"lips": None}}, {"camera": "a"}, SCORES | {"camera": 1}],
)
def test_unknown_keys_missing_keys_and_wrong_types_are_refused(tmp_path: Path, wrong: Any) -> None:
    with pytest.raises(ValidationError):
        write_result(tmp_path / "holdout.json", HeldOutCamera, wrong)
    assert not (tmp_path / "holdout.json").exists()


def test_the_committed_schemas_are_up_to_date(tmp_path: Path) -> None:
    """If this fails, run `python -m hnerf.results docs/schemas`."""
    write_schemas(tmp_path)
    assert {path.stem for path in SCHEMAS.iterdir()} == set(FILES)
    for path in SCHEMAS.iterdir():
        assert path.read_text() == (tmp_path / path.name).read_text(), path.name


@pytest.mark.parametrize(("given", "status"), [(["--help"], 0), ([], 2), (["a", "b"], 2), (["--folder"], 2)])
def test_the_program_writes_into_one_folder_only(
    given: list[str], status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(given)
    assert ended.value.code == status
    assert "usage: python -m hnerf.results" in "".join(capsys.readouterr())
    assert not list(tmp_path.iterdir())


def test_the_program_writes_all_schemas(tmp_path: Path) -> None:
    main([str(tmp_path / "schemas")])
    assert {path.stem for path in (tmp_path / "schemas").iterdir()} == set(FILES)
