"""A network of another author as a network of this project."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import torch
from annotated_types import Interval, Len
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.geometry.padding import pad_to
from rgbt.models.external.building import build, namespace, seeded
from rgbt.models.external.calling import FEEDS, Feed, ScorePath, ScorePaths, edge_map, scores_at
from rgbt.models.inputs import Images, Inputs, only_view
from rgbt.processes import rank
from rgbt.ranges import NumClasses, Size, Text
from rgbt.requirements import Record, Requirement
from rgbt.types import MaskPair, Output, View

OWN = "network."
"""Before every name of the author's network in `state_dict`."""

EVALUATION_SEED = 0
"""Seed of what a network draws in evaluation, so that two evaluations agree."""


class ExternalNetwork(nn.Module):
    """A network that is built from its author's checkout, whose code is executed.

    What it draws at random comes from the generator of the step, in evaluation from a fixed seed;
    global generators do not advance.

    Args:
        num_classes: K.
        checkout: folder of the author's repository.
        root: folder in it that is put on the path of modules.
        constructor: "module:name" of the class or function that returns the network; or
            "file.py:name" of an adapter beside the recipe (`rgbt.models.external.adapting`).
        arguments: of the constructor.
        namespaces: further arguments, which are objects with these attributes.
        feed: arguments of the call. "stacked": one tensor of RGB and thermal; "pair": two tensors;
            "pair_and_edges": and an edge map; "list": a list of two; "dicts": a list of
            {"image": stacked} per image; "thermal": thermal alone.
        inputs: normalisation; how many values thermal has decides how many channels are passed.
        multiple: sides are padded to multiples of it.
        size_hw: images are resized to this size, and scores back; None: not.
        scores: paths of the class scores in the output; several are added.
        train_scores: the same in training; None: `scores`.
        auxiliary: path of further scores with a loss of their own in training; None: none.
        resize: whether scores of another size are resized to the input (bilinear).
        one_by_one: whether each image is passed alone.
        weights_prefix: before the names of the network in a file of weights.

    Raises:
        InputError: it cannot be imported or built; `root` leads out of `checkout`.
    """

    def __init__(  # noqa: PLR0913 - each is a key of conf/model/external.yaml
        self,
        *,
        num_classes: NumClasses,
        checkout: Text,
        root: Text,
        constructor: Annotated[str, Len(3, 4096)],
        arguments: dict[str, Any],
        namespaces: dict[str, dict[str, Any]],
        feed: Feed,
        inputs: Inputs,
        multiple: Annotated[int, Interval(ge=1, le=1024)],
        size_hw: Size | None,
        scores: ScorePaths,
        train_scores: ScorePaths | None,
        auxiliary: ScorePath | None,
        resize: bool,
        one_by_one: bool,
        weights_prefix: Annotated[str, Len(0, 4096)],
    ) -> None:
        super().__init__()
        self.num_classes, self.constructor = num_classes, constructor
        self.record = self.record_from(
            feed=feed, auxiliary=auxiliary, weights_prefix=weights_prefix
        )
        self.feed, self.multiple, self.size_hw = feed, multiple, size_hw
        self.scores, self.train_scores = scores, train_scores or scores
        self.auxiliary = auxiliary
        self.resize, self.one_by_one = resize, one_by_one
        self.inputs = inputs
        whole = Path(checkout).expanduser().resolve()
        folder = (whole / root).resolve()
        if not folder.is_relative_to(whole):  # the user trusts `checkout`
            raise InputError(f"model.root={root} leads out of model.checkout={checkout}.")
        spaces = {key: namespace(each) for key, each in namespaces.items()}
        self.network = build(folder, constructor, arguments | spaces)

    @staticmethod
    def record_from(
        *, feed: Feed, auxiliary: ScorePath | None, weights_prefix: str, **_: object
    ) -> Record:
        """Views, auxiliary scores, which the loss must read, and names in the author's files."""
        reads = Requirement("loss", "reads_auxiliary", True, "model.auxiliary")
        return Record(
            views=("thermal",) if feed == "thermal" else ("rgbt",),
            auxiliary=auxiliary is not None,
            requires=(reads,) if auxiliary is not None else (),
            author_names=(OWN, weights_prefix),
        )

    def forward(
        self,
        rgb: Tensor,
        thermal: Tensor,
        masks: MaskPair | None = None,
        *,
        views: tuple[View, ...] = (),
        generator: torch.Generator | None = None,
    ) -> Output:
        """Class scores as `rgbt.models` says; in training `aux["aux_logits"]` if `auxiliary`.

        Raises:
            InputError: the network returns something else.
        """
        only_view(views, self.record.views, self.constructor)
        images = self.inputs(rgb, thermal, masks, multiple=self.multiple)
        edges = edge_map(rgb, thermal) if self.feed == "pair_and_edges" else thermal
        edges = pad_to(edges, (images.rgb.shape[2], images.rgb.shape[3]))
        if self.size_hw is not None:
            images = Images(*(_resized(each, self.size_hw) for each in images))
            edges = _resized(edges, self.size_hw)
        seed = EVALUATION_SEED
        if self.training:
            assert generator is not None, "a network in training gets the generator of the step"
            drawn = torch.randint(2**31, (), generator=generator, device=generator.device)
            seed = int(drawn) ^ rank()
        size = 1 if self.one_by_one else len(rgb)
        with seeded(seed, rgb.device):
            parts = [
                self._called(Images(images.rgb[n : n + size], images.thermal[n : n + size]), each)
                for n, each in zip(range(0, len(rgb), size), torch.split(edges, size), strict=True)
            ]
        found = (torch.cat(each) for each in zip(*parts, strict=True))
        logits, *auxiliary = (self._at_input(each, images.rgb, rgb) for each in found)
        return Output(logits, {"aux_logits": auxiliary[0]} if auxiliary else {})

    def _called(self, images: Images, edges: Tensor) -> list[Tensor]:
        """The scores, and in training the auxiliary ones, at the size that the network returns."""
        output = self.network(*FEEDS[self.feed](images, edges[:, 0]))
        shape = len(edges), self.num_classes
        name = "train_scores" if self.training else "scores"
        found = [scores_at(output, getattr(self, name), f"model.{name}", shape)]
        if self.training and self.auxiliary is not None:
            found.append(scores_at(output, (self.auxiliary,), "model.auxiliary", shape))
        return found

    def _at_input(self, scores: Tensor, called: Tensor, images: Tensor) -> Tensor:
        """Scores at the size of the images, as float32."""
        scores = scores.float()
        called_hw, hw = called.shape[2:], images.shape[2:]
        if scores.shape[2:] != called_hw and not self.resize:
            raise InputError(
                f"model.scores: the network returns scores of {tuple(scores.shape[2:])} for "
                f"images of {tuple(called_hw)} pixels; set model.resize=true to enlarge them, or "
                "model.multiple if its output is rounded."
            )
        if self.size_hw is not None:
            return _resized(scores, hw)
        scores = scores if scores.shape[2:] == called_hw else _resized(scores, called_hw)
        return scores[..., : hw[0], : hw[1]]


def _resized(maps: Tensor, hw: tuple[int, ...]) -> Tensor:
    """(N, C, H, W) at another size, bilinear."""
    return F.interpolate(maps, size=tuple(hw), mode="bilinear", align_corners=False)
