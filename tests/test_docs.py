"""The Markdown files refer only to what exists: files, headings, paths of code, answers to "where is ...?"."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "CHANGELOG")] + sorted((ROOT / "docs").glob("*.md"))
LINK = re.compile(r"\]\(([^)\s]+)\)")
CODE = re.compile(r"\b((?:hnerf|tasks|flows|tests|benchmarks|examples|configs|docs)/[\w./-]*\.(?:py|yaml|md))\b")
MODULE = re.compile(r"\bhnerf((?:\.[a-z_]+)+)")
ANSWER = re.compile(r"`([\w/]+\.py)`, `(\w+)`")


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_link_targets_exist(page: Path) -> None:
    for link in LINK.findall(page.read_text()):
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{page.name}: {link}"
        assert not anchor or anchor in anchors(target), f"{page.name}: {link}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_named_code_exists(page: Path) -> None:
    text = page.read_text()
    for path in CODE.findall(text):
        assert (ROOT / path).exists(), f"{page.name}: {path}"
    for name in MODULE.findall(text):
        *package, last = name.strip(".").split(".")
        module = ROOT.joinpath("hnerf", *package)
        inside = module.with_suffix(".py")
        found = (module / last).is_dir() or (module / f"{last}.py").exists()
        assert found or (inside.exists() and re.search(rf"\b{last}", inside.read_text())), f"{page.name}: hnerf{name}"


def test_answers_to_where_is_name_existing_code() -> None:
    answers = ANSWER.findall((ROOT / "CONTRIBUTING.md").read_text())
    assert len(answers) >= 12
    for path, name in answers:
        defined = rf"^(?:def |class |    def )?{name}\b(?:[(:\[ ]|$)"
        assert re.search(defined, (ROOT / path).read_text(), re.MULTILINE), f"{path}: no {name}"


def test_every_package_has_an_api_page() -> None:
    nav = (ROOT / "mkdocs.yml").read_text()
    assert "::: hnerf.{package}" in (ROOT / "docs" / "hooks.py").read_text()  # which writes the pages
    for path in (ROOT / "hnerf").glob("*/__init__.py"):
        assert f"api/{path.parent.name}.md" in nav


def test_the_design_names_every_module_and_package() -> None:
    text = (ROOT / "docs" / "design.md").read_text()
    packages = [f"{path.parent.name}/" for path in (ROOT / "hnerf").glob("*/__init__.py")]
    modules = [path.name for path in (ROOT / "hnerf").glob("*.py") if path.name != "__init__.py"]
    assert [name for name in packages + modules if f"`{name}`" not in text] == []


def test_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 100
