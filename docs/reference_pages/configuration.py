"""Pages of the configuration: every group with its files, keys, types, defaults and source."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from pydantic import PydanticSchemaGenerationError, TypeAdapter
from pydantic.errors import PydanticInvalidForJsonSchema

from reference_pages.docstrings import description, parameters
from reference_pages.guides import about, link
from reference_pages.markdown import block, code, page, table
from rgbt.config.component import RUN_SETTINGS, constructor, setting_types
from rgbt.config.compose import conf_dir, load_choice, variants_of

OWN_PAGES = ("experiment",)
"""Groups that have a page of another form (`reference_pages.experiments`)."""


class ConfigFile(NamedTuple):
    """One file of conf/.

    Attributes:
        name: of the file, without ".yaml".
        path: from the root of the repository.
        text: of the file.
        about: its first comment, in one line.
        choices: values of each name that chooses it on the command line: of its variants, too.
    """

    name: str
    path: str
    text: str
    about: str
    choices: dict[str, Any]


def groups() -> list[str]:
    """Every folder of conf/ with files, nested ones with a slash: "model/inputs"."""
    root = Path(conf_dir())
    folders = {path.parent.relative_to(root).as_posix() for path in root.rglob("*.yaml")}
    return sorted(folders - {"."})


def files_of(group: str) -> list[ConfigFile]:
    """The files of a group, by name."""
    paths = sorted((Path(conf_dir()) / group).glob("*.yaml"))
    return [_file(path, group) for path in paths]


def _file(path: Path, group: str) -> ConfigFile:
    text, variants = path.read_text(), variants_of(path)
    names = [path.stem] if None not in variants.values() else []
    names += [f"{path.stem}_{each}" for each in variants]
    choices = {name: load_choice(f"{group}/{name}") for name in names}
    shown = f"conf/{group}/{path.name}"
    return ConfigFile(path.stem, shown, text, " ".join(header(text).split()), choices)


def header(text: str) -> str:
    """The comment at the top of a file, without marks; a line of Hydra's (@package) is left out."""
    lines = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        if not line.startswith("# @"):
            lines.append(line.removeprefix("#").removeprefix(" "))
    return "\n".join(lines)


END = re.compile(r"(?<!\bSec)(?<!\bEq)(?<!\bEqs)(?<!\bFig)(?<!\bNo)(?<!\be\.g)(?<!\bi\.e)[.:] ")
"""The end of a sentence, and not of an abbreviation."""


def first_sentence(text: str) -> str:
    """Up to the first full stop or colon that ends a sentence."""
    return END.split(f"{text} ", maxsplit=1)[0].strip()


def page_name(group: str) -> str:
    """Path of the page of a group in the site, from docs/."""
    if group in OWN_PAGES:
        return f"reference/{group}s.md"
    return f"reference/configuration/{group.replace('/', '-')}.md"


def pages() -> dict[str, str]:
    """Text of the pages of the configuration, by path in docs/."""
    own = [group for group in groups() if group not in OWN_PAGES]
    return {
        "reference/configuration/index.md": index_page(),
        **{page_name(group): group_page(group) for group in own},
    }


def group_page_paths() -> list[str]:
    """Paths of the pages of the groups, for the navigation."""
    return [page_name(group) for group in groups() if group not in OWN_PAGES]


def index_page() -> str:
    """All groups, and the default configuration."""
    chosen = _defaults()
    rows = [
        [
            f"[`{group}`]({_from_configuration(group)})",
            about(group),
            code(chosen.get(group, "")),
            link("groups", group, 2),
        ]
        for group in groups()
    ]
    base = (Path(conf_dir()) / "config.yaml").read_text()
    return page(
        "# Configuration",
        "A run is composed of one file of each group. `GROUP=FILE` on the command line chooses "
        "another file, `KEY=VALUE` sets one key, and `+experiment=NAME` adds a published method. "
        "`rgbt run ... --cfg job` prints the whole configuration of a command. A file may hold "
        "several choices: `b4` under `_variants_` of `conf/model/cmx.yaml` is `model=cmx_b4`, with "
        "the values of the file where the variant has no other ones.",
        table(["Group", "What it sets", "Default", "Guide"], rows),
        "## Default configuration",
        "The keys of a run that belong to no group, and the file of each group that is used by "
        "default.",
        block(base, "yaml", "conf/config.yaml"),
    )


def _from_configuration(group: str) -> str:
    return page_name(group).removeprefix("reference/configuration/").replace("reference/", "../")


def _defaults() -> dict[str, str]:
    entries = yaml.safe_load((Path(conf_dir()) / "config.yaml").read_text())["defaults"]
    return {
        key: value
        for entry in entries
        if isinstance(entry, dict)
        for key, value in entry.items()
        if not key.startswith("override ")
    }


def group_page(group: str) -> str:
    """One group: its files, the settings of the classes that they configure, and their text."""
    files = files_of(group)
    default = _defaults().get(group)
    choose = f"Choose a file with `{group}=NAME`"
    return page(
        f"# `{group}`",
        about(group),
        f"{choose}; the default is `{default}`." if default else f"{choose}.",
        "The column *Default* shows the value of the default file, or of the file in brackets.",
        f"Guide: {link('groups', group, 2)}" if link("groups", group, 2) else "",
        table(
            ["File", "What it is"],
            [[_link(each), first_sentence(each.about)] for each in files],
        ),
        "## Settings",
        *_settings(group, files),
        "## Files",
        *(part for each in files for part in (f"### {each.name}", _source(each))),
    )


def _link(file: ConfigFile) -> str:
    """The names that choose a file, with a link to its text."""
    first, *others = file.choices
    return ", ".join([f"[`{first}`](#{file.name})", *map(code, others)])


def _source(file: ConfigFile) -> str:
    return block(file.text, "yaml", file.path)


def comments(text: str) -> dict[str, str]:
    """What the comments beside the keys of a file, and in the lines above them, say."""
    found, above = {}, []
    for line in text.splitlines():
        if comment := re.match(r"\s*# (.*)", line):
            above.append(comment[1])
            continue
        if entry := re.match(r"\s*(\w+):[^#]*(?:# (.*))?", line):
            found[entry[1]] = " ".join([*above, entry[2] or ""]).strip()
        above = []
    return found


def _settings(group: str, files: list[ConfigFile]) -> Iterator[str]:
    found: dict[str, dict[str, str]] = {}  # target -> key -> the value of the file that sets it
    default = _defaults().get(group)
    said: dict[str, dict[str, str]] = {}
    pairs = [(name, each) for each in files for name in each.choices]
    for name, file in sorted(pairs, key=lambda pair: pair[0] != default):
        for target, values in _targets(file.choices[name]):
            entry = found.setdefault(target, {})
            said[target] = comments(file.text) | said.get(target, {})
            for key, value in values.items():
                shown = code(_shown(value))
                entry.setdefault(key, shown if name == default else f"{shown} ({name})")
    if not found:
        yield "These files set keys of other groups. The comments say what each key means."
    for target, values in found.items():
        made = constructor(target, group)
        yield f"### {target.rpartition('.')[2]}"
        yield code(target)
        yield description(made)
        yield _keys(made, values, said[target])
    if group in RUN_SETTINGS:
        yield "### Settings of the run"
        yield "The run itself reads these keys; the constructor does not take them."
        kinds = RUN_SETTINGS[group].items()
        yield table(["Key", "Type and range"], [[code(key), kind_of(kind)] for key, kind in kinds])


def _targets(node: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """Every `_target_` in a file, with the values that are set beside it."""
    if isinstance(node, dict):
        if "_target_" in node:
            yield (
                node["_target_"],
                {str(key): value for key, value in node.items() if key != "_target_"},
            )
        for value in node.values():
            yield from _targets(value)
    elif isinstance(node, list):
        for value in node:
            yield from _targets(value)


def _keys(made: Any, values: dict[str, str], said: dict[str, str]) -> str:
    """Table of the settings of a constructor; objects that the run provides are left out.

    The meaning of one that the docstring does not explain is what the files of conf/ say.
    """
    documented = said | parameters(made)
    signature = inspect.signature(made).parameters
    rows = []
    for name, kind in setting_types(made).items():
        parameter = signature.get(name)
        if parameter is None or (name not in values and parameter.default is parameter.empty):
            continue
        value = values.get(name) or f"{code(_shown(parameter.default))} (class)"
        rows.append([code(name), kind_of(kind), value, documented.get(name, "")])
    return table(["Key", "Type and range", "Default", "Meaning"], rows)


def kind_of(annotation: Any) -> str:
    """What an annotation takes, for a cell of a table: "number from 0 to 1, or null"."""
    try:
        schema = TypeAdapter(annotation).json_schema()
    except (PydanticSchemaGenerationError, PydanticInvalidForJsonSchema):
        return "a mapping with `_target_`"
    return _in_words(schema)


BOUNDS = {
    "minimum": "from {}",
    "exclusiveMinimum": "above {}",
    "maximum": "to {}",
    "exclusiveMaximum": "below {}",
    "multipleOf": "in steps of {}",
    "minItems": "of at least {}",
    "maxItems": "of at most {}",
}


def _in_words(schema: dict[str, Any]) -> str:
    """A JSON schema in words."""
    if "anyOf" in schema:
        return " or ".join(map(_in_words, schema["anyOf"]))
    if "enum" in schema or "const" in schema:
        return ", ".join(map(repr, schema.get("enum") or [schema["const"]]))
    if "$ref" in schema or schema.get("type") == "object":
        return "mapping"
    bounds = (text.format(f"{schema[key]:g}") for key, text in BOUNDS.items() if key in schema)
    items = schema.get("prefixItems") or [schema.get("items") or {}]
    each = {_in_words(item) for item in items} if schema.get("type") == "array" else ()
    kind = "list" if each else schema.get("type", "any value")
    return " ".join([kind, *bounds, *(["each", " or ".join(sorted(each))] if any(each) else [])])


def _shown(value: Any) -> str:
    """A value as YAML in one line."""
    plain = list(value) if isinstance(value, tuple) else value
    text = yaml.safe_dump(plain, default_flow_style=True, width=10**6, sort_keys=False)
    shown = text.removesuffix("...\n").strip()
    return shown if len(shown) <= 60 else f"{shown[:57]}..."
