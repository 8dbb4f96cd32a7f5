"""Load a trained network from a run folder, a file of weights or an exported file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rgbt.assembly.session import (
    Session,
    measured_settings,
    names_key,
    open_session,
    reader_settings,
)
from rgbt.checks import InputError, check_choice
from rgbt.config.common_options import AS_TRAINED, NetworkOptions
from rgbt.config.compose import compose
from rgbt.config.stored_config import (
    check_targets,
    checkouts,
    parse_trust,
    read_settings,
    settings_of,
)
from rgbt.data.thermal import Range
from rgbt.engine.checkpoint import check_origin, load_checkpoint, restore_weights, step_of
from rgbt.files.plain_files import check_links
from rgbt.files.yaml_files import parse_yaml
from rgbt.metrics.counts import Counts
from rgbt.metrics.measurement import dataset_words
from rgbt.runs.folder import ADVICE, Marker, find_run, read_marker, read_provenance, run_key
from rgbt.runs.run_spec import RunSpec, settings_digest
from rgbt.runs.source_code import code_of
from rgbt.runs.specify import CHECKOUT, load_spec, specify
from rgbt.terminal import warn

if TYPE_CHECKING:  # few commands map classes
    from rgbt.data.label_map import LabelMap

CHECKPOINTS = ("best", "last")


def trusted_settings(
    folder: Path, trust: Collection[str] = (), overrides: Sequence[str] = ()
) -> dict[str, Any]:
    """Return the configuration of a run, whose objects may be built; InputError if not trusted.

    A checkout that `overrides` name instead of the stored one is trusted.
    """
    check_links(folder)
    settings = read_settings(folder / "config.yaml")
    typed = [word.partition("=")[2] for word in overrides if word.startswith(f"{CHECKOUT}=")]
    if typed and CHECKOUT in checkouts(settings):
        named = str(parse_yaml(typed[-1], CHECKOUT))
        settings["model"]["checkout"] = named
        trust = (*trust, str(Path(named).expanduser().resolve()))
    check_targets(settings, trust, str(folder / "config.yaml"))
    return settings


def open_named(
    options: NetworkOptions,
    overrides: Sequence[str],
    regions: str = AS_TRAINED,
    label_map: LabelMap | None = None,
) -> Session:
    """Open the network that options of a command name; `regions`: a file of ``conf/metric``."""
    if options.run and options.exported is not None:
        raise InputError("exported: it has its own weights; omit run=.")
    source = options.exported or options.run
    words = [*overrides, *([] if regions == AS_TRAINED else [f"metric={regions}"])]
    trust = parse_trust(options.trust)
    return open_network(source, options.runs_dir, words, options.checkpoint, label_map, trust)


def open_network(
    source: str | Path,
    runs_dir: Path,
    overrides: Sequence[str],
    checkpoint: str = "best",
    label_map: LabelMap | None = None,
    trust: Collection[str] = (),
) -> Session:
    """Open a trained network: of a run, of a file of `rgbt export`, or of a file of weights.

    Evaluations of files are written below `runs_dir` by default.

    Args:
        source: folder, config key or MLflow run id; or, as a path, an ONNX file, which names its
            data set and settings. "": the weights are those of `model.weights` in the configuration
            of `overrides` at scale=paper.
        runs_dir: the folder of runs.
        overrides: of the configuration, see `rgbt.runs.specify.load_spec`.
        checkpoint: "best" by the selection split, or "last".
        label_map: from the classes it was trained with to those of the data set, where they differ.
        trust: modules that the configuration may name (`rgbt.config.stored_config`).

    Raises:
        InputError: as `open_run`; no weights, or a file that does not hold all of them.
    """
    if source and isinstance(source, str):
        return open_run(find_run(source, runs_dir), overrides, checkpoint, label_map, trust)
    if checkpoint != "best":
        raise InputError(f"checkpoint={checkpoint} requires run=...")
    if isinstance(source, Path):
        from rgbt.exported.onnx_network import ExportedNetwork  # few networks are exported

        network = ExportedNetwork.read(source)
        made = network.description
        settings = settings_of(made.settings, str(source))
        check_targets(settings, trust, str(source))
        session = open_session(load_spec(settings, overrides), label_map, network=network)
        if label_map is None:
            _check_classes(session, made.classes, source)
        path, name, step = source, source.stem, made.step
        changed = _changed(session, settings, made.fingerprint)
    else:
        config = compose(["scale=paper", f"runs_dir={runs_dir}", *overrides])
        if config.model.get("weights") is None:
            raise InputError("run: missing; name a run=..., or a network and model.weights=...")
        spec = specify(config)
        session = open_session(spec, label_map)
        assert spec.weights_path is not None, "model.weights has a value"
        if session.weights is not None and session.weights.fresh:
            raise InputError(
                f"model.weights: {session.weights.sentence()}; the other parameters of the network "
                "would be random."
            )
        path, name, step = spec.weights_path, spec.key, 0
        changed = _typed(session, overrides)
    # Copies of a data set in other folders may hold other images.
    folder = runs_dir / "evaluations" / f"{name}-{session.dataset.fingerprint()[:8]}"
    digest = _digest(path, session)
    found = replace(session, step=step, folder=folder, label=path.name)
    return replace(found, digest=digest, changed=changed)


def open_run(
    folder: Path,
    overrides: Sequence[str],
    checkpoint: str = "best",
    label_map: LabelMap | None = None,
    trust: Collection[str] = (),
) -> Session:
    """Open the network of the run in a folder; other arguments as of `open_network`.

    Raises:
        InputError: a target not trusted, overrides that do not fit, no checkpoint, other classes.
    """
    trained_with = trusted_settings(folder, trust, overrides)
    spec = load_spec(trained_with, overrides)
    _warn_of_other_code(folder, trained_with)
    check_choice("checkpoint", checkpoint, CHECKPOINTS)
    session = with_weights(spec, folder, checkpoint, trained_with, label_map)
    words = dataset_words(overrides)
    if "dataset" in session.changed or any(word.startswith("dataset.") for word in words):
        changed = dict.fromkeys((*session.changed, "dataset"))
        session = replace(session, dataset_words=words, changed=tuple(changed))
    counts = sorted(folder.glob("counts_*.npz"))
    if counts and label_map is None:
        _check_classes(session, Counts.load(counts[0]).classes, folder)
    if trained_with["dataset"].get("name") == spec.dataset.plain.get("name"):
        _warn_of_other_splits(folder, session)
    return session


def with_weights(
    spec: RunSpec,
    folder: Path,
    checkpoint: str,
    trained_with: Mapping[str, Any],
    label_map: LabelMap | None = None,
) -> Session:
    """Open the network of `spec` with a checkpoint of its folder, "best" or "last".

    `trained_with` are the plain settings of the run, which the checkpoint has to belong to.
    """
    weights = folder / f"{checkpoint}.pt"
    if not weights.is_file():
        raise InputError(f"{folder} has no {weights.name}; rerun its command to resume it.")
    check_links(folder)
    payload = load_checkpoint(weights)
    check_origin(payload, weights, run_key(folder), settings_digest(trained_with))
    marker = read_marker(folder)
    found = _found_range(marker, trained_with, spec, folder)
    session = open_session(spec, label_map, load_weights=False, thermal_range=found)
    restore_weights(session.model, payload["model"], weights)
    return replace(
        session,
        step=step_of(payload, weights),
        folder=folder,
        label=spec.name,
        run=run_key(folder),
        checkpoint=checkpoint,
        changed=_changed(session, trained_with, None if marker is None else marker["files"]),
    )


def _found_range(
    marker: Marker | None, trained_with: Mapping[str, Any], spec: RunSpec, folder: Path
) -> Range | None:
    """Return the thermal range that `auto` of a run found; None for another setting.

    Degrees Celsius are those of any data set with a unit, stored values those of one without.
    """
    trained, now = (plain["dataset"].get("thermal_range") for plain in (trained_with, spec.plain))
    limits = trained.get("range") if isinstance(trained, Mapping) else trained
    if limits != "auto" or isinstance(trained, Mapping) != isinstance(now, Mapping):
        return None
    low, high = (0.0, 0.0) if marker is None else marker.get("thermal_range", (0.0, 0.0))
    if not low < high:
        raise InputError(f"{folder / 'dataset.json'} has no thermal_range of the run; {ADVICE}.")
    return low, high


def _changed(
    session: Session, trained_with: Mapping[str, Any], fingerprint: str | None
) -> tuple[str, ...]:
    """See `Session.changed`; `fingerprint` of the data set that the network was trained on."""
    before, now = measured_settings(trained_with), measured_settings(session.spec.plain)
    read = [key.removeprefix("dataset.") for key in reader_settings(session.dataset)]
    for values, plain in ((before, trained_with), (now, session.spec.plain)):
        values |= {f"dataset.{key}": plain["dataset"].get(key) for key in read}
    changed = [key for key in sorted(now) if before.get(key) != now[key]]
    nodes = (dict(plain["metric"]) for plain in (trained_with, session.spec.plain))
    first, second = ({key: node[key] for key in node.keys() - {"absent"}} for node in nodes)
    changed += ["partition"] if first != second else []
    changed += ["dataset"] if fingerprint not in (None, session.dataset.fingerprint()) else []
    return tuple(changed)


def _typed(session: Session, overrides: Sequence[str]) -> tuple[str, ...]:
    """Return the settings of a network that is no run which were typed; see `Session.changed`."""
    every = (word.lstrip("+").partition("=")[0] for word in overrides)
    words = [word for word in every if word != "dataset"]  # its images say what it is
    read = reader_settings(session.dataset)
    known = sorted(measured_settings(session.spec.plain) | read)
    changed = [key for key in known if any(f"{key}.".startswith(f"{word}.") for word in words)]
    is_cut = any(word.split(".")[0] == "metric" for word in words)
    return (*changed, *(["partition"] if is_cut else []))


def _digest(path: Path, session: Session) -> str:
    """Return the SHA-256 in hexadecimal of a file of weights and of the settings of the network."""
    model = {key: value for key, value in session.spec.model.plain.items() if key != "weights"}
    digest = hashlib.sha256(json.dumps(model, sort_keys=True).encode())
    with path.open("rb") as file:
        digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _check_classes(session: Session, trained: tuple[str, ...], source: Path) -> None:
    if trained != tuple(session.dataset.classes):
        raise InputError(
            f"{source} was trained with the classes {', '.join(trained)}, but "
            f"{session.dataset.name} has {', '.join(session.dataset.classes)}. `rgbt predict` can "
            "map classes with label_map=..."
        )


def _warn_of_other_code(folder: Path, trained_with: Mapping[str, Any]) -> None:
    """Warn where the user's own code is not the code that the run was trained with."""
    now = code_of(trained_with)
    entries = read_provenance(folder / "provenance.json") if now else []
    before = entries[-1].get("own_code") if entries else None
    if before is not None and before != now:
        modules = sorted(name for name in {*before, *now} if before.get(name) != now.get(name))
        warn(
            f"{', '.join(modules)} changed after {folder.name} was trained, so the results will "
            "differ from those of the run. Restore the code, or train again."
        )


def _warn_of_other_splits(folder: Path, session: Session) -> None:
    """Warn where the data set that a run was trained on has other splits now."""
    if session.spec.dataset.plain.get("name") is None:
        return
    try:
        now, before = names_key(session), read_marker(folder)
    except (InputError, OSError):
        return  # nothing to compare with
    if before is not None and now != before["names"]:
        warn(
            f"the splits of {session.dataset.name} ({session.dataset.root}) are not those of "
            f"{folder.name}, so training images may be among the evaluated images."
        )
