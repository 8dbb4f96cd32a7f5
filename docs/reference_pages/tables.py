"""The page of published tables: what each file of sweeps/tables/ holds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

import sweeps
from reference_pages.markdown import block, code, page, table

TABLES = Path(sweeps.__file__).parent / "tables"


def tables_page() -> str:
    """Every table of the papers: caption, rows, columns, remarks, and the command that runs it."""
    paths = sorted(TABLES.rglob("*.yaml"))
    names = [path.relative_to(TABLES).with_suffix("").as_posix() for path in paths]
    specs = [yaml.safe_load(path.read_text()) for path in paths]
    anchors = [name.replace("/", "") for name in names]
    rows = [
        [f"[`{name}`](#{anchor})", spec["caption"], _runnable(spec)]
        for name, anchor, spec in zip(names, anchors, specs, strict=True)
    ]
    sections = [
        part for name, spec in zip(names, specs, strict=True) for part in _section(name, spec)
    ]
    return page(
        "# Published tables",
        "Each results table of the four papers is a file, and `field/2026` has printed numbers of "
        "other networks. `rgbt reproduce table=NAME` runs the rows, where they can be run, and "
        "prints them beside the published values. Measured "
        "values are on the pages of [Results](../results/index.md).",
        table(["Table", "Caption", "Rows that can be run"], rows),
        *sections,
    )


def _runnable(spec: dict[str, Any]) -> str:
    rows = spec["rows"]
    return f"{sum('experiment' in row or 'overrides' in row for row in rows)} of {len(rows)}"


def _section(name: str, spec: dict[str, Any]) -> list[str]:
    columns = [each["name"] for each in spec["columns"]]
    remarks = []
    for remark in spec.get("remarks", []):
        for text in [remark] if isinstance(remark, str) else remark.values():
            remarks.append(f"- {' '.join(text.split())}")
    rows = [
        [
            row["label"],
            code(f"+experiment={row['experiment']}") if "experiment" in row else "",
            *(_value(row.get("values", {}).get(column)) for column in columns),
        ]
        for row in spec["rows"]
    ]
    return [
        f"## {name}",
        f"{spec['paper']}, {spec['number']}: {spec['caption']} Published values, {spec['unit']}; "
        f"data: {spec['data']}.",
        block(f"rgbt reproduce table={name} seeds=3 workers=2", "bash"),
        table(["Row", "Experiment", *columns], rows),
        *_claims(spec),
        *_forms(spec),
        "\n".join(remarks),
    ]


def _value(value: Any) -> str:
    return "" if value is None else str(value)


def _claims(spec: dict[str, Any]) -> list[str]:
    """What the paper says about the table, as it is judged by `rgbt reproduce`."""
    claims = [
        [code(each["name"]), " ".join(each["says"].split()), each["source"]]
        for each in spec.get("claims", [])
    ]
    return [table(["Claim", "Statement", "Place"], claims)] if claims else []


def _forms(spec: dict[str, Any]) -> list[str]:
    return [
        f"`form={form}`: {' '.join(sentence.split())}"
        for form, sentence in spec.get("forms", {}).items()
    ]
