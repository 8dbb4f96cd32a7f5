"""Load weights from a file into a network, completely or not at all."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import nn

from rgbt.checkpoints.layout import FAMILIES, Facts, Rule, family_of
from rgbt.checkpoints.plan import Plan, adapted, make_plan
from rgbt.checkpoints.read import Contents, read
from rgbt.checkpoints.recognise import LAYOUTS, recognise
from rgbt.checkpoints.report import Report, counted, refusal
from rgbt.checks import InputError, not_finite
from rgbt.requirements import record_of


def load_weights(
    model: nn.Module, path: Path | str, fresh: tuple[str, ...] = (), *, other_classes: bool = False
) -> Report:
    """Set the weights of a network from a file, ours or a released one.

    Every name of the file must be used or known to be unused. Every entry of the network must be
    set or known to be absent from such a file. Otherwise nothing is changed.

    Args:
        model: the network; its class says which layouts fit.
        path: of the file (see `rgbt.checkpoints.read.read`).
        fresh: parts that keep their initial values, by the beginning of their names, such as
            "sem_seg_head.predictor.class_embed" for another number of classes.
        other_classes: whether parts whose shape differs keep their initial values too.

    Raises:
        InputError: unreadable, asking for code, of another network, incomplete, of another shape,
            or with NaN or infinity.
    """
    contents = read(Path(path))
    facts, plan, remarks = plan_for(model, contents, fresh, other_classes=other_classes)
    state = model.state_dict()
    if not plan.fits:
        raise InputError(refusal(contents.path, facts, plan, family_of(type(model)), len(state)))
    broken = not_finite({name: plan.tensors[name] for name in plan.values.values()})
    if broken:
        raise InputError(
            f"{contents.path}: '{broken[0]}' holds NaN or infinity ({len(broken)} of "
            f"{len(plan.values)} tensors do), because the training that wrote it diverged. Use a "
            "checkpoint of an earlier step."
        )
    with torch.no_grad():
        for entry, name in plan.values.items():
            state[entry].copy_(adapted(plan.tensors[name], state[entry]))
        for entry in plan.zeros:
            state[entry].zero_()
    return Report(
        path=contents.path,
        container=contents.container,
        facts=facts,
        num_entries=len(state),
        num_set=len(plan.values),
        num_zeros=len(plan.zeros),
        fresh=counted(plan.fresh),
        leftover=counted(plan.leftover),
        remarks=(*facts.remarks, *remarks),
    )


def plan_for(
    model: nn.Module, contents: Contents, fresh: tuple[str, ...], *, other_classes: bool = False
) -> tuple[Facts, Plan, tuple[str, ...]]:
    """What a file is, where its tensors go in `model`, and remarks on that.

    Raises:
        InputError: the file is of no use to this network at all.
    """
    facts = recognise(contents)
    family = family_of(type(model))
    rule, tensors = None, contents.tensors
    of_any = not facts.family or (facts.layout == "own" and not family)
    if facts.layout in LAYOUTS and (of_any or facts.family == family):
        try:
            rule = LAYOUTS[facts.layout].rule(family, model, facts)
        except InputError as error:
            raise InputError(f"{contents.path} is {error}") from error
        tensors = tensors if rule is None else LAYOUTS[facts.layout].converted(tensors)
    prefix = facts.prefix
    if rule is None and contents.tensors.keys() == model.state_dict().keys():
        rule = Rule()  # with exactly its own names, any network takes the file
    names = record_of(model).author_names
    if rule is None and names is not None:
        rule, prefix = Rule(source=lambda entry: entry.removeprefix(names[0])), names[1]
    if rule is None:
        raise InputError(_another_network(model, contents, facts))
    plan = make_plan(
        model.state_dict(keep_vars=True),
        tensors,
        rule,
        prefix=prefix,
        fresh=fresh,
        other_classes=other_classes,
    )
    kinds = sorted({str(plan.tensors[name].dtype) for name in plan.values.values()})
    short = [kind.removeprefix("torch.") for kind in kinds if kind.endswith("float16")]
    converted = (f"{' and '.join(short)} converted",) if short else ()
    return facts, plan, (*rule.remarks, *converted)


def _another_network(model: nn.Module, contents: Contents, facts: Facts) -> str:
    family = family_of(type(model))
    if not family:
        return (
            f"{contents.path} ({facts.title}) has other parameter names than "
            f"{type(model).__name__}. A network that is not part of rgbt.models can only load "
            "files of its own runs."
        )
    fits = " or ".join(" ".join(each) for each in facts.fits)
    advice = f"it fits {fits}" if fits else "`rgbt weights inspect` shows its names"
    return (
        f"{contents.path} ({facts.title}) cannot be loaded into {FAMILIES.get(family, family)}; "
        f"{advice}."
    )
