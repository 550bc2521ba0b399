"""The pages of the documentation site, as a hook of MkDocs: README and the pages beside it are among them.

docs/ is the top of the site, README.md its first page, and the pages beside README.md lie in project/. A file
that a page links to, such as config/yolov5.yaml, is copied: each link of the repository is one of the site.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

REPOSITORY = Path(__file__).parents[1]
FIRST = "README.md"
_LINK = re.compile(r"(?<=\]\()([^)#\s]+)(?=[#)])")


def site_path(path: str) -> str:
    """Where the site has a file of the repository; both with / and relative to their top."""
    if path == FIRST:
        return "index.md"
    # In lower case and apart: where case does not count, SECURITY.md and docs/security.md have one name.
    if path.endswith(".md") and "/" not in path:
        return f"project/{path.lower()}"
    return path.removeprefix("docs/")


def linked(page: str) -> Iterator[str]:
    """The files of the repository that the page at `page` links to, as paths from its top."""
    for link in _LINK.findall((REPOSITORY / page).read_text(encoding="utf-8")):
        target = _target(page, link)
        if (REPOSITORY / target).is_file():
            yield target


def published() -> set[str]:
    """The files of the repository that the site shows: README.md, docs/, and all that their links reach."""
    found: set[str] = set()
    waiting = [FIRST, *(f"docs/{page.name}" for page in (REPOSITORY / "docs").glob("*.md"))]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += linked(path) if path.endswith(".md") else []
    return found


def with_links_of_site(text: str, page: str) -> str:
    """`text` of the page at `page`, its links rewritten as those between the pages of the site."""
    folder = posixpath.dirname(site_path(page))

    def rewritten(link: re.Match[str]) -> str:
        target = _target(page, link[1])
        if not (REPOSITORY / target).is_file():
            return link[1]
        return posixpath.relpath(site_path(target), folder or ".")

    return _LINK.sub(rewritten, text)


def _target(page: str, link: str) -> str:
    return posixpath.normpath(posixpath.join(posixpath.dirname(page), link))


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Called by MkDocs first: what is indented by two spaces below an item belongs to it, as on the forge."""
    from markdown import Extension, Markdown

    class TwoSpaces(Extension):
        def extendMarkdown(self, md: Markdown) -> None:  # noqa: N802
            md.tab_length = 2
            md.build_parser()  # which has read the length; what other extensions add comes after this

    config.markdown_extensions.insert(0, TwoSpaces())
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Called by MkDocs with the files of docs/: add the others."""
    from mkdocs.structure.files import File

    for path in sorted(published()):
        if not path.startswith("docs/"):
            files.append(File.generated(config, site_path(path), abs_src_path=str(REPOSITORY / path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Called by MkDocs with the text of each page."""
    return with_links_of_site(markdown, Path(page.file.abs_src_path or "").relative_to(REPOSITORY).as_posix())
