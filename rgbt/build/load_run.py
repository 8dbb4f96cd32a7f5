"""Load a trained network from a run folder or from a file of weights."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rgbt.build.session import Session, names_key, open_session
from rgbt.checks import InputError, check_choice
from rgbt.config.compose import compose
from rgbt.config.stored_config import check_targets, checkouts, read_settings, settings_of
from rgbt.data.label_map import LabelMap
from rgbt.engine.checkpoint import load_checkpoint, restore_weights, step_of
from rgbt.exported.onnx_network import ExportedNetwork
from rgbt.files.yaml_files import parse_yaml
from rgbt.metrics.counts import Counts
from rgbt.spec.checkout_code import code_of
from rgbt.spec.load_spec import CHECKOUT, load_spec
from rgbt.spec.specify import specify
from rgbt.tracking.run_files import read_marker, read_provenance
from rgbt.tracking.run_folder import find_run
from rgbt.tracking.terminal import warn

CHECKPOINTS = ("best", "last")


@dataclass(frozen=True)
class TrainedNetwork:
    """A network with trained weights and everything that evaluates it.

    Attributes:
        session: its objects; the network holds the trained weights.
        step: the optimiser step of the weights; 0 where the file does not say.
        folder: where its evaluations are written by default.
        label: its name in tables.
    """

    session: Session
    step: int
    folder: Path
    label: str


def open_trained(
    run: str,
    runs_dir: Path,
    overrides: Sequence[str],
    checkpoint: str = "best",
    label_map: LabelMap | None = None,
    trust: Collection[str] = (),
) -> TrainedNetwork:
    """The network of the run `run`; without one, that of `overrides` with `model.weights`.

    A run is named by its folder, config key or MLflow run id. Without one ("") the overrides are of
    the configuration at scale=paper, such as model=mfnet model.weights=final.pth
    dataset.root=/data/MFNet. The other arguments are those of `open_run`.

    Raises:
        InputError: no such run; no weights; settings that do not fit.
    """
    if run:
        return open_run(find_run(run, runs_dir), overrides, checkpoint, label_map, trust)
    config = compose(["scale=paper", f"runs_dir={runs_dir}", *overrides])
    if config.model.get("weights") is None:
        raise InputError(
            "'run' has no value; give one with run=..., or a network with weights from a file: "
            "model=mfnet model.weights=final.pth dataset.root=/data/MFNet."
        )
    if checkpoint != "best":
        raise InputError(
            f"checkpoint={checkpoint} selects a checkpoint of a run, but no run is given; name "
            "one with run=..."
        )
    spec = specify(config)
    path = spec.weights_path
    assert path is not None, "model.weights has a value"
    session = open_session(spec, label_map)
    if session.weights is not None and session.weights.fresh:
        raise InputError(
            f"{path} does not hold all parameters of the network, and the others would be random: "
            f"{session.weights.sentence()}. Train the network first with python -m rgbt.run."
        )
    # Copies of a data set in other folders may hold other images.
    name = f"{spec.key}-{session.dataset.fingerprint()[:8]}"
    return TrainedNetwork(session, 0, runs_dir / "evaluations" / name, path.name)


def open_exported(
    path: Path,
    runs_dir: Path,
    overrides: Sequence[str],
    label_map: LabelMap | None = None,
    trust: Collection[str] = (),
) -> TrainedNetwork:
    """The network of a file of `rgbt export`, with the data set and settings that the file names.

    Args:
        path: of the ONNX file.
        runs_dir: folder of runs; evaluations are written below it by default.
        overrides: of its configuration, as of a run.
        label_map: as in `open_run`.
        trust: see there.

    Raises:
        InputError: a file that is refused (`ExportedNetwork`), a target that is not trusted,
            overrides that do not fit, a data set of other classes.
    """
    network = ExportedNetwork.read(path)
    made = network.description
    settings = settings_of(made.settings, str(path))
    check_targets(settings, trust, str(path))
    session = open_session(load_spec(settings, overrides), label_map, network=network)
    if label_map is None and made.classes != tuple(session.dataset.classes):
        raise InputError(
            f"{path} has the classes {', '.join(made.classes)}, but {session.dataset.name} has "
            f"{', '.join(session.dataset.classes)}. Choose another data set with dataset=..., or "
            "map the classes with label_map=..."
        )
    folder = runs_dir / "evaluations" / f"{path.stem}-{session.dataset.fingerprint()[:8]}"
    return TrainedNetwork(session, made.step, folder, path.name)


def trusted_settings(
    folder: Path, trust: Collection[str] = (), overrides: Sequence[str] = ()
) -> dict[str, Any]:
    """The configuration of a run, whose objects may be built.

    A checkout that `overrides` name instead of the stored one is trusted.

    Raises:
        InputError: not readable, or a target or checkout that is not trusted.
    """
    settings = read_settings(folder / "config.yaml")
    typed = [word.partition("=")[2] for word in overrides if word.startswith(f"{CHECKOUT}=")]
    if typed and CHECKOUT in checkouts(settings):
        named = str(parse_yaml(typed[-1], CHECKOUT))
        settings["model"]["checkout"] = named
        trust = (*trust, str(Path(named).expanduser().resolve()))
    check_targets(settings, trust, str(folder / "config.yaml"))
    return settings


def open_run(
    folder: Path,
    overrides: Sequence[str],
    checkpoint: str = "best",
    label_map: LabelMap | None = None,
    trust: Collection[str] = (),
) -> TrainedNetwork:
    """The network of a run with its weights.

    Args:
        folder: the run folder.
        overrides: of its configuration, see `rgbt.spec.load_spec.load_spec`.
        checkpoint: "best" by the selection split, or "last".
        label_map: from the classes it was trained with to those of the data set, where they differ.
        trust: modules that its configuration may name (`rgbt.config.stored_config`).

    Raises:
        InputError: a target that is not trusted, overrides that do not fit, no checkpoint, other
            classes than trained.
    """
    trained_with = trusted_settings(folder, trust, overrides)
    spec = load_spec(trained_with, overrides)
    _warn_of_other_code(folder, trained_with)
    check_choice("checkpoint", checkpoint, CHECKPOINTS)
    weights = folder / f"{checkpoint}.pt"
    if not weights.is_file():
        raise InputError(
            f"{folder} has no {weights.name}, because the run has not reached its first "
            "evaluation; rerun its command to resume it"
            + (", or use checkpoint=last." if (folder / "last.pt").is_file() else ".")
        )
    payload = load_checkpoint(weights)
    session = open_session(spec, label_map)
    for path in sorted(folder.glob("counts_*.npz"))[:1]:
        trained = Counts.load(path).classes
        if label_map is None and trained != tuple(session.dataset.classes):
            raise InputError(
                f"{folder} was trained with the classes {', '.join(trained)}, but "
                f"{session.dataset.name} has {', '.join(session.dataset.classes)}. `rgbt predict` "
                "can map classes with label_map=..."
            )
    restore_weights(session.model, payload["model"], weights)
    if trained_with["dataset"].get("name") == spec.dataset.plain.get("name"):
        _warn_of_other_splits(folder, session)
    return TrainedNetwork(session, step_of(payload, weights), folder / "evaluations", spec.name)


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
    """Warn where the data set that a run was trained on has other splits now.

    The lists were changed, or shares are drawn again from other files: training images may be
    among the images that are evaluated.
    """
    if session.spec.dataset.plain.get("name") is None:
        return
    try:
        now, before = names_key(session), read_marker(folder)
    except (InputError, OSError):
        return  # nothing to compare with
    if before is not None and now != before["names"]:
        warn(
            f"the splits of {session.dataset.name} ({session.dataset.root}) are not those that "
            f"{folder.name} was trained with, so training images may be among the evaluated "
            "images."
        )
