"""Show pages that lie outside docs/ on the site, too: README, CONTRIBUTING, CHANGELOG and the committed results; and
write the pages of the packages' API."""

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parent.parent
OUTSIDE = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "LICENSE", "benchmarks/results/**/*.*")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the files of OUTSIDE under their paths in the repository, and pages of packages without one in docs/api/."""
    for pattern in OUTSIDE:
        for path in sorted(ROOT.glob(pattern)):
            files.append(File.generated(config, path.relative_to(ROOT).as_posix(), abs_src_path=str(path)))
    for path in sorted((ROOT / "hnerf").glob("*/__init__.py")):
        package = path.parent.name
        if f"api/{package}.md" not in files.src_uris:
            text = f"# `hnerf.{package}`\n\n::: hnerf.{package}\n"
            files.append(File.generated(config, f"api/{package}.md", content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Rewrite links for the site, where docs/ is the root."""
    if page.file.src_uri in OUTSIDE:
        return re.sub(r"\]\(docs/", "](", markdown)
    return re.sub(r"\]\(\.\./(?=README|CONTRIBUTING|CHANGELOG|benchmarks/)", "](", markdown)
