"""The one engine of intervals: a contrast is a weighted sum of scores of runs.

A score with its interval is a contrast of one term, a comparison one of two, a claim of a paper one
of its cells, a factorial effect one of all cells of a design. Blocks of images are drawn anew, the
same for all terms, so that what an image does to all of them cancels. The runs (seeds) are few:
their spread is Student's or that of a confidence sequence, and not that of a bootstrap over tasks
as in rliable (Agarwal et al., NeurIPS 2021).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from analysis.uncertainty.blocks import ImageBlocks, Resampling, Values, make_blocks
from analysis.uncertainty.intervals import Spread, over_images, over_seeds
from analysis.uncertainty.same_images import Alike, check_same_kind, in_order
from rgbt.checks import InputError
from rgbt.metrics import names
from rgbt.metrics.counts import FEWEST, Counts, convention
from rgbt.metrics.details import details_of
from rgbt.metrics.metric import Absent
from rgbt.metrics.named import ParsedMetric, images_of, parse, sums_of, value, values
from rgbt.metrics.pairs import HEADLINES, protocol_of
from rgbt.metrics.score_grid import headlines

# Seed of counts that belong to no seed: a folder of predictions, one file of weights.
FIXED = -1

# Most numbers in the drawn sums that a resampler keeps, because many scores read the same: 32 MiB.
KEPT = 2**22


@dataclass(frozen=True, kw_only=True)
class Term:
    """One score (`rgbt.metrics.named`) in a linear contrast.

    Attributes:
        counts: by seed; of one seed the same images in all terms. Folds of a cross-validation are
            seeds with other images. `{FIXED: counts}` for a method without seeds.
        keys: by seed, identity of the counts: equal keys, equal counts.
    """

    weight: float
    metric: str
    counts: Mapping[int, Counts]
    keys: Mapping[int, str]

    def __post_init__(self) -> None:
        is_mixed = FIXED in self.counts and len(self.counts) > 1
        if is_mixed or not self.counts or set(self.counts) != set(self.keys):
            raise ValueError("term: expected counts and keys of one seed or more, or fixed ones.")

    @property
    def fixed(self) -> bool:
        """Whether it has no seeds."""
        return FIXED in self.counts


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What the data say about one contrast.

    Attributes:
        values: contrast of each seed that all terms with seeds have; one value of fixed terms
            alone, and of methods whose seeds are not paired. Percent points; of Var squared.
        seeds: of `values`; () where all terms are fixed or not paired.
        error: standard error of their mean over the draw of the images; NaN with too few blocks.
        blocks: number of blocks of images that hold images of the metric.
        said: what was drawn, and why, see `analysis.uncertainty.blocks.ImageBlocks`.
        drawn: (resamples,) contrasts with blocks drawn anew; () with too few.
        trainings: error over seeds; None for a single seed.
    """

    values: tuple[float, ...]
    seeds: tuple[int, ...]
    error: float
    blocks: int
    said: str
    reason: str = ""
    drawn: Values = field(default_factory=lambda: np.empty(0), repr=False, compare=False)
    trainings: Spread | None = None

    @property
    def images(self) -> Spread | None:
        """Error over the draw of the images; None with too few blocks or nothing to score."""
        return None if math.isnan(self.error) else Spread(self.error, self.blocks - 1)


def combine(weights: Sequence[float], parts: Sequence[Evidence]) -> Evidence:
    """Return the evidence about a weighted sum of contrasts with the same seeds and draws."""
    first = parts[0]
    if any((part.seeds, part.blocks) != (first.seeds, first.blocks) for part in parts):
        raise ValueError("combine: expected the same seeds and images in all parts.")
    of_seeds = np.array(weights) @ np.array([part.values for part in parts])
    drawn = np.array(weights) @ np.array([part.drawn for part in parts])
    spread = over_images(drawn, first.blocks)
    return replace(
        first,
        values=tuple(of_seeds.tolist()),
        error=math.nan if spread is None else spread.error,
        drawn=drawn,
        trainings=over_seeds(of_seeds),
    )


class Resampler:
    """Evidence about contrasts; scores of a run are resampled once, in whatever table they are.

    Images are drawn in the order of their names, so that the draws depend on no term. With
    ``blocks=auto`` the length of the blocks is that of each contrast (see
    `analysis.uncertainty.blocks.make_blocks`).

    `alike` is what the counts must have in common beside images and classes. Draws of a score are
    kept (16 kB of 2,000), those of the sums that it reads up to `KEPT`.
    """

    def __init__(self, settings: Resampling, alike: Alike = "labels") -> None:
        self._settings = settings
        self._alike = alike
        self._ordered: dict[str, Counts] = {}
        self._compared: set[tuple[str, str]] = set()
        self._sums: dict[tuple[object, ...], Values] = {}
        self._resampled: dict[tuple[str, str, Absent, tuple[str, ...], bytes], Values] = {}
        self._values: dict[tuple[str, str, Absent], float] = {}
        self._influences: dict[tuple[str, Absent, tuple[str, ...]], Values] = {}

    def evidence(self, terms: Sequence[Term], *, paired: bool = True) -> Evidence:
        """Do the same as `contrast`, with an InputError where a run has nothing to score."""
        found = self.contrast(terms, paired=paired)
        if np.isnan(found.values).any():
            keys = ", ".join(dict.fromkeys(key for term in terms for key in term.keys.values()))
            raise InputError(
                f"'{terms[0].metric}' of one of {keys} has nothing to score: no pixel is labelled "
                "or predicted so. Use absent=released, or omit the column."
            )
        return found

    def contrast(self, terms: Sequence[Term], *, paired: bool = True) -> Evidence:
        """Return what the data say about the weighted sum of `terms`; NaN: nothing to score.

        Fixed terms are paired with every seed of the others. For a mean of contrasts, pass the
        terms of all of them with their weights divided by the number of contrasts.

        Args:
            terms: one or more.
            paired: whether equal seeds are one training, or share their initial weights and the
                order of their data. If not, the spreads of the terms add up (Welch).

        Raises:
            InputError: other images, classes or labels; no common seed; blocks that cannot be made.
        """
        seeds = _common_seeds(terms) if paired else ()
        every = [counts for term in terms for counts in term.counts.values()]
        absent = self._settings.absent or convention(every)
        runs = _among_all([self._runs(terms[0], term, seeds) for term in terms])
        first = next(iter(runs[0].values()))
        blocks = make_blocks(first.names, self._settings.blocks, self._series(terms, runs, absent))
        used = blocks.count
        for term, of_term in zip(terms, runs, strict=True):
            held = images_of(parse(term.metric), next(iter(of_term.values()))).names
            used = min(used, len(np.unique(blocks.index[np.isin(first.names, held)])))
        parts, drawn = [], np.zeros(self._settings.resamples if used >= FEWEST else 0)
        for term, of_term in zip(terms, runs, strict=True):
            points = [
                self._value(term.metric, key, counts, absent) for key, counts in of_term.items()
            ]
            parts.append(term.weight * np.array(points))
            if len(drawn):
                scores = self._drawn(term.metric, of_term, blocks, absent)
                drawn += term.weight * np.mean(scores, axis=0)
        means = np.broadcast_arrays(*parts) if paired else [part.mean() for part in parts]
        of_seeds = np.sum(means, axis=0)
        of_images = over_images(drawn, used)
        return Evidence(
            values=tuple(np.atleast_1d(of_seeds).tolist()),
            seeds=seeds,
            error=math.nan if of_images is None else of_images.error,
            blocks=used,
            said=blocks.said if used == blocks.count else f"{used} of {blocks.said}",
            reason=blocks.reason,
            drawn=drawn,
            trainings=over_seeds(of_seeds) if paired else over_seeds(*parts),
        )

    def _runs(self, reference: Term, term: Term, seeds: Sequence[int]) -> dict[str, Counts]:
        """Return the counts of the used seeds by key, images in the order of their names.

        Of a seed, the images are those of the reference, or of its first seed where it has none.
        """
        firsts = [seed for seed in seeds if seed in reference.counts] or sorted(reference.counts)
        first = reference.counts[firsts[0]]
        found = {}
        for seed in seeds if seeds and not term.fixed else sorted(term.counts):
            key = term.keys[seed]
            # Folds have other images; of others, all seeds are compared with the first.
            own = reference.counts.get(seed, first)
            is_fold = own.names != first.names and set(own.names) != set(first.names)
            like = seed if is_fold else firsts[0]
            name = reference.keys[like]
            if (name, key) not in self._compared:
                if is_fold:
                    check_same_kind(first, term.counts[seed], self._alike)
                same = in_order(reference.counts[like], term.counts[seed], self._alike)
                names = tuple(sorted(same.names))
                self._ordered[key] = same if same.names == names else same.select(names)
                self._compared.add((name, key))
            found[key] = self._ordered[key]
        return found

    def _series(
        self, terms: Sequence[Term], runs: Sequence[Mapping[str, Counts]], absent: Absent
    ) -> Values | None:
        """Return the influence (L, N) of images on terms and contrast, for "auto" blocks."""
        if self._settings.blocks != "auto":
            return None
        of_terms, weighted, kinds = [], [], set()
        for term, of_term in zip(terms, runs, strict=True):
            influences = []
            for key, counts in of_term.items():
                influences.append(self._influence(key, counts, absent))
                kinds.add(watched(counts))
            of_terms.append(np.mean(influences, axis=0))
            weighted.append(term.weight * of_terms[-1])
        if len(terms) > 1 and len(kinds) == 1:
            of_terms.append(np.sum(weighted, axis=0))
        return np.asarray(np.nan_to_num(np.concatenate(of_terms)), np.float64)

    def _influence(self, key: str, counts: Counts, absent: Absent) -> Values:
        """Return the `watched` scores (L, N) of all images but one."""
        place = (key, absent, counts.names)
        if place not in self._influences:
            series = []
            for metric in watched(counts):
                by_image = sums_of(metric, counts.counts, counts.partition)
                series.append(values(metric, by_image.sum(0) - by_image, counts, absent))
            self._influences[place] = np.stack(series)
        return self._influences[place]

    def _value(self, metric: str, key: str, counts: Counts, absent: Absent) -> float:
        """Return the score of all images."""
        if (key, metric, absent) not in self._values:
            self._values[key, metric, absent] = value(metric, counts, absent)
        return self._values[key, metric, absent]

    def _drawn(
        self, metric: str, runs: Mapping[str, Counts], blocks: ImageBlocks, absent: Absent
    ) -> list[Values]:
        """Return (resamples,) scores of each run with blocks drawn anew; NaN: nothing to score."""
        images = next(iter(runs.values())).names  # further folds have further images
        place, missing = (metric, absent, images, blocks.index.tobytes()), {}
        for key, counts in runs.items():
            if (key, *place) not in self._resampled:
                missing[key] = counts
        parsed, scores = parse(metric), {key: list[Values]() for key in missing}
        for key, sums in self._drawn_sums(parsed, missing, images, blocks):
            scores[key].append(values(parsed, sums, missing[key], absent))
        self._resampled |= {(key, *place): np.concatenate(scores[key]) for key in missing}
        return [self._resampled[key, *place] for key in runs]

    def _drawn_sums(
        self,
        metric: ParsedMetric,
        runs: Mapping[str, Counts],
        images: tuple[str, ...],
        blocks: ImageBlocks,
    ) -> Iterator[tuple[str, Values]]:
        """Yield keys with drawn sums (..., M, K) that the metric reads, some resamples at once."""
        place = (metric.sums, images, blocks.index.tobytes())
        to_draw = {}
        for key, counts in runs.items():
            if (key, *place) in self._sums:
                yield key, self._sums[key, *place]
                continue
            by_image = _by_image(metric, counts)
            to_draw[key] = blocks.summed(by_image.reshape(len(by_image), -1)), by_image.shape[1:]
        numbers = sum(flat.shape[1] for flat, _ in to_draw.values()) * self._settings.resamples
        drawn = {key: list[Values]() for key in to_draw if numbers <= KEPT}
        for weights in blocks.draws(self._settings) if to_draw else ():
            for key, (flat, shape) in to_draw.items():
                sums = (weights @ flat).reshape(-1, *shape)
                yield key, sums
                if key in drawn:
                    drawn[key].append(sums)
        self._sums |= {(key, *place): np.concatenate(parts) for key, parts in drawn.items()}
        while sum(sums.size for sums in self._sums.values()) > KEPT:
            del self._sums[next(iter(self._sums))]  # the oldest


def _among_all(runs: Sequence[Mapping[str, Counts]]) -> list[dict[str, Counts]]:
    """Return runs as counts of the images of all of them, in the order of their names."""
    first = next(iter(runs[0].values())).names
    if all(counts.names == first for of_term in runs for counts in of_term.values()):
        return [dict(of_term) for of_term in runs]
    nights: dict[str, bool | None] = {}
    for of_term in runs:
        for counts in of_term.values():
            nights |= zip(counts.names, counts.night or [None] * len(counts.names), strict=True)
    every = tuple(sorted(nights))
    known = [nights[name] for name in every]
    night = None if None in known else tuple(map(bool, known))
    found = []
    for of_term in runs:
        found.append({key: counts.among(every, night) for key, counts in of_term.items()})
    return found


def watched(like: Counts) -> tuple[ParsedMetric, ...]:
    """Return the main scores, which tell how far neighbouring images are alike.

    Single frames have pixel accuracy too, which shows likeness most clearly.
    """
    if details_of(like.partition) is not None:
        return tuple(map(parse, headlines(like)))
    protocol = protocol_of(like.partition)
    single = (names.MIOU, names.PIXEL_ACCURACY)
    return tuple(map(parse, HEADLINES[protocol] if protocol else single))


def _by_image(metric: ParsedMetric, counts: Counts) -> Values:
    """Return what the metric reads (N, ..., M, K); images of another part of the day are 0."""
    sums = sums_of(metric, counts.counts, counts.partition)
    if metric.part is None:
        return sums
    used = np.isin(counts.names, images_of(metric, counts).names)
    return sums * used.reshape(-1, *[1] * (sums.ndim - 1))


def _common_seeds(terms: Sequence[Term]) -> tuple[int, ...]:
    """Return the seeds that all terms with seeds have, ascending; () where all are fixed."""
    trained = [set(term.counts) for term in terms if not term.fixed]
    shared = set.intersection(*trained) if trained else set()
    if trained and not shared:
        lists = [", ".join(map(str, sorted(seeds))) for seeds in trained]
        raise InputError(
            f"the compared rows have no seed in common: {' and '.join(dict.fromkeys(lists))}. "
            "Train the same seeds of each row."
        )
    return tuple(sorted(shared))
