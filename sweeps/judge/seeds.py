"""Which seeds judge a claim, and by which rule.

The seeds that a table declares (`sweeps.plan.table.Table.confirm`) were chosen before any of them
was run: exactly these, all of them, are judged by the rule for a fixed number. All other seeds
explore: more of them may have been run because of what the first ones showed, so that the rule must
be valid at any time.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from analysis.uncertainty.contrasts import Term
from analysis.uncertainty.verdicts import Rule
from rgbt.checks import InputError

# The scores of runs, with weights, that a contrast is made of.
Scores = frozenset[tuple[tuple[str, ...], float]]

EXPLORING = Rule(any_time=True)
CONFIRMING = Rule()


def of_others(terms: Sequence[Term], declared: Collection[int]) -> list[Term]:
    """Return the terms without the declared seeds; InputError: a row has no other seed."""
    found = []
    for term in terms:
        seeds = [seed for seed in term.counts if seed not in declared]
        if not seeds:
            names = ", ".join(map(str, sorted(declared)))
            raise InputError(f"not all of the declared seeds {names} are finished.")
        found.append(with_seeds(term, seeds))
    return found


def of_declared(terms: Sequence[Term], declared: Collection[int]) -> list[Term]:
    """Return the terms with the declared seeds alone; [] where one of them is not finished."""
    seeds = sorted(declared)
    is_trained = any(not term.fixed for term in terms)
    if not seeds or not is_trained:
        return []
    if any(not term.fixed and not term.counts.keys() >= set(seeds) for term in terms):
        return []
    return [term if term.fixed else with_seeds(term, seeds) for term in terms]


def with_seeds(term: Term, seeds: Sequence[int]) -> Term:
    """Return a term with these seeds alone."""
    counts = {seed: term.counts[seed] for seed in seeds}
    return replace(term, counts=counts, keys={seed: term.keys[seed] for seed in seeds})


def scores_of(terms: Sequence[Term], sign: float = 1.0) -> Scores:
    """Return what a weighted sum is made of: equal ones are of the same scores of the same runs."""
    sums: dict[tuple[str, ...], float] = {}
    for term in terms:
        source = (term.metric, *term.keys.values())
        sums[source] = sums.get(source, 0.0) + sign * term.weight
    return frozenset((source, round(weight, 9)) for source, weight in sums.items() if weight)


def negated(scores: Scores) -> Scores:
    """Return the scores of the opposite contrast."""
    return frozenset((source, -weight) for source, weight in scores)
