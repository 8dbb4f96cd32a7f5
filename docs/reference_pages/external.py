"""The page of other authors' networks: one row per recipe, from its file in conf/model/external."""

from __future__ import annotations

import re

import yaml

from reference_pages.configuration import ConfigFile, files_of
from reference_pages.markdown import code, page, table

GROUP = "model/external"
FACT = re.compile(
    r"(?P<what>.*?)(?: Published: (?P<published>.*))? Repository: (?P<repository>\S+) "
    r"Commit: (?P<commit>\w+ \(\S+\))\. Licence: (?P<licence>.*?)\. "
    r"Lists: (?P<lists>.*?)\.(?: (?P<remarks>.*))?$"
)
"""The comment at the top of a recipe, in one line."""
PACKAGES = re.compile(r"[Tt]he packages? (.*?) (?:is|are) necessary")
TRIED = re.compile(r" ?Tried: (.*?)\.$")
"""In the remarks of a recipe."""


def external_page() -> str:
    """All recipes: what they are, where the code is, and how the network is called."""
    files = files_of(GROUP)
    return page(
        "# External networks",
        "Recipes for networks of other authors, which are built from a checkout of the author's "
        "repository: `rgbt run +experiment=mfnet model=external/gmnet "
        "model.checkout=/code/GMNet`. [How to use them](../how-to/use-an-external-network.md). "
        'This project holds no code of these repositories. Where the licence is "none", the '
        "authors permit no copies of their code.",
        "## Repositories",
        table(
            [
                "`model=external/`",
                "Network",
                "Published",
                "Lists",
                "Repository",
                "Commit",
                "Licence",
            ],
            [_origin(each) for each in files],
        ),
        "Published figures are those of the README, or of the paper if the column names it. "
        "Figures of papers were not compared with the text. *Lists* are those that the published "
        'weights were trained and selected on; "not checked" where the repository does not say.',
        "## What they need, and what was tried",
        "On a CPU and from random weights, with the packages beside PyTorch that the recipe names. "
        "*Trained* means six steps on the embedded data set, with a finite loss that changes.",
        table(
            ["`model=external/`", "Packages", "Tried"],
            [_attempt(each) for each in files],
        ),  # fmt: skip
        "## How they are called",
        table(
            ["`model=external/`", "Constructor", "Feed", "Inputs", "Sizes", "Scores"],
            [_call(each) for each in files],
        ),  # fmt: skip
        "All keys: [configuration/model](configuration/model.md) and "
        "[configuration/model-external](configuration/model-external.md), which has the remarks on "
        "every network.",
    )


def facts(file: ConfigFile) -> dict[str, str]:
    """What the comment of a recipe states, by name.

    Raises:
        ValueError: the comment has another form.
    """
    found = FACT.match(file.about)
    if found is None:
        raise ValueError(f"{file.path}: the comment lacks Repository, Commit or Licence.")
    return {key: (value or "").rstrip(".") for key, value in found.groupdict().items()}


def _origin(file: ConfigFile) -> list[str]:
    stated = facts(file)
    name = stated["repository"]
    link = f"[{name if len(name) < 50 else f'{name[:47]}...'}](https://github.com/{name})"
    return [
        code(file.name),
        stated["what"].rstrip("."),
        stated["published"] or "-",
        stated["lists"],
        link,
        stated["commit"],
        stated["licence"],
    ]


def _attempt(file: ConfigFile) -> list[str]:
    remarks = facts(file)["remarks"] + "."
    packages, tried = PACKAGES.search(remarks), TRIED.search(remarks)
    return [
        code(file.name),
        packages[1] if packages else "-",
        tried[1] if tried else "built and predicted (2026-11-26)",
    ]


def _call(file: ConfigFile) -> list[str]:
    keys = yaml.safe_load(file.text)
    chosen = {key: each for entry in keys["defaults"] if isinstance(entry, dict)
              for key, each in entry.items()}  # fmt: skip
    inputs = code(str(next(iter(chosen.values()))))
    changed = ", ".join(code(f"{k}={v}") for k, v in keys.get("inputs", {}).items())
    size = keys.get("size_hw")
    sizes = (
        f"resized to {size[0]} x {size[1]}" if size else f"multiples of {keys.get('multiple', 1)}"
    )
    return [
        code(file.name),
        code(keys["constructor"]),
        code(keys["feed"]),
        f"{inputs}, {changed}" if changed else inputs,
        sizes,
        code(str(keys.get("scores", [[]]))),
    ]
