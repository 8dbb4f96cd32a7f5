"""The page of experiments: what each is, how it is run, what is expected of it."""

from __future__ import annotations

import re
from collections.abc import Iterator

from reference_pages.configuration import ConfigFile, files_of, first_sentence, header
from reference_pages.guides import link
from reference_pages.markdown import block, page, table

FIELD = re.compile(r"^(Run|Expect|Variants):\s*", re.MULTILINE)


def experiments_page() -> str:
    """Every file of conf/experiment/ with its header and its text."""
    files = files_of("experiment")
    rows = [
        [
            f"[`{each.name}`](#{each.name})",
            first_sentence(each.about),
            link("experiments", each.name, 1),
        ]
        for each in files
    ]
    return page(
        "# Experiments",
        "An experiment is a method as published: a file that chooses other groups. Add it with "
        "`rgbt run +experiment=NAME`. *Expect* gives the printed value at `scale=paper`; at the "
        "default `scale=demo` the values are other ones, see [Results](../results/index.md).",
        table(["Experiment", "What it is", "Guide"], rows),
        *(part for each in files for part in _section(each)),
    )


def _section(file: ConfigFile) -> Iterator[str]:
    about, *fields = FIELD.split(header(file.text))
    yield f"## {file.name}"
    yield " ".join(about.split())
    named = dict(zip(fields[::2], fields[1::2], strict=True))
    if "Run" in named:
        yield block(" ".join(named["Run"].split()), "bash")
    for name in ("Expect", "Variants"):
        if name in named:
            yield f"**{name}**: {' '.join(named[name].split())}"
    yield block(file.text, "yaml", file.path)
