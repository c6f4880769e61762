"""What the site has beside the pages of the four shelves: a start page, and a page for every public object."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

import yid_ocp

REPOSITORY = Path(__file__).resolve().parents[1]
SHELVES = {"Start": "start", "How-to": "howto", "Explain": "explain", "Reference": "reference"}


def pages(shelf: str) -> list[str]:
    """Pages of one shelf, in the order of the index `docs/README.md`."""
    index = (REPOSITORY / "docs" / "README.md").read_text(encoding="utf-8")
    return re.findall(rf"^\| \[\w+\.md\]\(({shelf}/\w+\.md)\)", index, re.MULTILINE)


def chapters() -> list[str]:
    """Pages of the folder `design`, in the order of its index."""
    index = (REPOSITORY / "docs" / "design" / "README.md").read_text(encoding="utf-8")
    return ["design/README.md", *(f"design/{name}" for name in re.findall(r"^\| \[(\w+\.md)\]", index, re.MULTILINE))]


def public() -> list[str]:
    """Names of the front door, classes first."""
    names = [name for name in yid_ocp.__all__ if not name.startswith("_")]
    return sorted(names, key=lambda name: (name[0].islower(), name.lower()))


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Fill the navigation."""
    config.nav = ["index.md", "glossary.md", *({title: pages(shelf)} for title, shelf in SHELVES.items())]
    config.nav.append({"Design": chapters()})
    config.nav.append({"Python": [{name: f"api/{name}.md"} for name in public()]})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what is generated: the README as start page, and a page for every public object from its docstring."""
    readme = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    # what stands beside the README is no page; `on_page_markdown` takes a link that leads upwards for a name
    inside = re.sub(r"\]\((?=[\w-]+\.md)", "](../", readme).replace("](docs/", "](")
    files.append(File.generated(config, "index.md", content=inside))
    for name in public():
        entry = getattr(yid_ocp, name)
        text = f"# {name}\n\n`yid_ocp.{name}`\n\n::: {entry.__module__}.{entry.__qualname__}\n"
        text += "    options: {heading_level: 2}\n"
        files.append(File.generated(config, f"api/{name}.md", content=text))
    return files


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Files of the repository that are no pages are named, not linked; the file name of a code block is its title."""

    def kept(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(page.file.src_uri), link[2].split("#")[0]))
        known = re.fullmatch(r"(?!\.\./)[\w/-]+\.(md|png|gif|svg|webp)", target) and target != "README.md"
        return link[0] if known or link[2].startswith(("https:", "http:", "#")) else link[1]

    # a fence with a second word would be no code block
    titled = re.sub(r"^```(\w+) (\w\S*)$", r'```\1 title="\2"', markdown, flags=re.MULTILINE)
    return re.sub(r"\[([^\]]*)\]\(([^)]*)\)", kept, titled)
