"""What changes the digest of a result's code, and what does not; which results are fresh."""

from collections.abc import Callable
from pathlib import Path

import pytest
from freshness import code_digest, sources, stale_reason
from provenance import RESULTS, ROOT
from registry import REGISTRY

from tests.benchmarks.checkout import Checkout, made

ONE = made("one", configs=("fast",))


@pytest.fixture
def checkout(tmp_path: Path) -> Checkout:
    return Checkout(tmp_path)


def test_sources_are_the_program_and_its_direct_and_indirect_imports(checkout: Checkout) -> None:
    names = [str(path.relative_to(checkout.root)) for path in sources(checkout.root, ONE)]
    assert names == ["benchmarks/program.py", "hnerf/__init__.py", "hnerf/far.py", "hnerf/near.py"]


@pytest.mark.parametrize(
    ("name", "text", "counts"),
    [
        ("hnerf/far.py", "NUMBER = 2\n", True),
        ("hnerf/__init__.py", "VERSION = 2\n", True),
        ("configs/fast.yaml", "steps: 11\n", True),
        ("benchmarks/program.py", "import hnerf.near\n", True),
        ("hnerf/far.py", '"""A docstring."""\n\nNUMBER   = (1)  # a comment\n', False),
        ("hnerf/unused.py", "NUMBER = 2\n", False),
        ("configs/fast.yaml", "steps:   10  # a comment\n", False),
    ],
)
def test_only_used_code_and_settings_change_the_digest(checkout: Checkout, name: str, text: str, counts: bool) -> None:
    before = code_digest(checkout.root, ONE)
    checkout.write(name, text)
    assert (code_digest(checkout.root, ONE) != before) is counts


def test_the_preset_that_a_preset_is_based_on_changes_the_digest(checkout: Checkout) -> None:
    checkout.write("configs/mine.yaml", "based_on: fast\n")
    mine = made("mine", configs=("mine",))
    before = code_digest(checkout.root, mine)
    checkout.write("configs/fast.yaml", "steps: 11\n")
    assert code_digest(checkout.root, mine) != before


@pytest.mark.parametrize(
    "text",
    [
        "def late():\n    from hnerf.unused import NUMBER\n    return NUMBER\nNUMBER = 1\n",
        'NUMBER = 1\nRUN = ["-m", "hnerf.unused"]\n',
        "NUMBER = 1\nimport hnerf.unused as other\n",
    ],
)
def test_modules_imported_late_or_started_by_name_are_sources(checkout: Checkout, text: str) -> None:
    checkout.write("hnerf/far.py", text)
    assert checkout.root / "hnerf" / "unused.py" in sources(checkout.root, ONE)


def test_programs_import_their_neighbours_and_packages_do_not(checkout: Checkout) -> None:
    neighbour = checkout.root / "benchmarks" / "neighbour.py"
    checkout.write("hnerf/far.py", "import neighbour\nNUMBER = 1\n")
    assert neighbour not in sources(checkout.root, ONE)
    checkout.write("benchmarks/program.py", "import neighbour\n")
    assert neighbour in sources(checkout.root, ONE)


def test_modules_listed_as_started_are_sources(checkout: Checkout) -> None:
    assert checkout.root / "hnerf" / "unused.py" in sources(checkout.root, made("one", runs=("hnerf.unused",)))


def test_the_command_changes_the_digest(checkout: Checkout) -> None:
    assert code_digest(checkout.root, made("one")) != code_digest(checkout.root, made("two"))


@pytest.mark.parametrize("harm", [Path.unlink, lambda path: path.write_text("34.5")])
def test_a_result_is_stale_if_its_files_were_removed_or_edited(
    checkout: Checkout, harm: Callable[[Path], object]
) -> None:
    checkout.write("benchmarks/results/one.md", "1")
    digest = code_digest(checkout.root, ONE)
    records = {"one": {"digest": digest, "files": {"one.md": sha256_of_1}}}
    assert stale_reason(checkout.root, ONE, {}) == "not recorded"
    assert stale_reason(checkout.root, ONE, records) is None
    harm(checkout.root / "benchmarks" / "results" / "one.md")
    assert stale_reason(checkout.root, ONE, records) == "one.md has changed since it was made"
    checkout.write("hnerf/far.py", "NUMBER = 2\n")
    assert stale_reason(checkout.root, ONE, records) == "its code has changed"


sha256_of_1 = "6b86b273ff34fce19d6b804eff5a3f5747ada4eaa22f1d49c01e52ddb7875b4b"  # printf 1 | sha256sum


def test_every_committed_file_belongs_to_one_result() -> None:
    files = [path for path in RESULTS.rglob("*") if path.is_file() and path.stem != "provenance"]
    owners = {path: [r.name for r in REGISTRY for f in r.files if path in RESULTS.glob(f)] for path in files}
    assert {str(path): names for path, names in owners.items() if len(names) != 1} == {}


def test_entries_have_unique_names_and_existing_programs_and_settings() -> None:
    assert len({result.name for result in REGISTRY}) == len(REGISTRY)
    for result in REGISTRY:
        assert (ROOT / "benchmarks" / result.command[0]).is_file()
        for pattern in result.configs:
            assert any((ROOT / "configs").glob(f"{pattern}.yaml")), f"{result.name}: no configs/{pattern}.yaml"


def test_sources_of_a_study_include_those_of_training_and_neither_the_asset_nor_other_studies() -> None:
    study = next(result for result in REGISTRY if result.name == "benchmark/valid-wave-static")
    names = {str(path.relative_to(ROOT)) for path in sources(ROOT, study)}
    assert {"hnerf/training/run.py", "tasks/rank.py", "hnerf/baselines/idr.py", "benchmarks/provenance.py"} <= names
    assert "flows/benchmark.py" in names
    assert not names & {"benchmarks/segmentation.py", "flows/stability.py", "flows/ablations.py"}
    assert [name for name in names if name.startswith("hnerf/asset/")] == []
