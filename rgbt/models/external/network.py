"""A network of another author as a network of this project."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Any

import torch
from annotated_types import Interval, Len
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError, RunError
from rgbt.models.external.building import Builder, advice, line_of, namespace, reason
from rgbt.models.external.calling import FEEDS, Feed, Path, edge_map, scores_at
from rgbt.models.external.checkout import Checkout
from rgbt.models.external.cuda_calls import cuda_calls_to
from rgbt.models.external.draws import seeded
from rgbt.models.inputs import Images, Inputs, only_view
from rgbt.processes import rank
from rgbt.ranges import Names, NumClasses, Size, Text
from rgbt.requirements import Record, Requirement
from rgbt.types import MaskPair, Output, View

OWN = "network."
"""Before every name of the author's network in `state_dict`."""

EVALUATION_SEED = 0
"""Seed of what a network draws in evaluation, so that two evaluations agree."""

Multiple = Annotated[int, Interval(ge=1, le=1024)]
Paths = Annotated[tuple[Path, ...], Len(1, 16)]


class ExternalNetwork(nn.Module):
    """A network that is built from its author's checkout, whose code is executed.

    Its constructor neither downloads nor reads weights. What it draws at random comes from the
    generator of the step, in evaluation from a fixed seed; global generators do not advance.

    Args:
        num_classes: K.
        checkout: folder of the author's repository.
        root: folder in it that is put on the path of modules.
        constructor: "module:name" of the class or function that returns the network.
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
        empty_packages: packages of the checkout whose ``__init__.py`` is not executed.
        stubs: modules that are not installed and that the network does not use -> the attributes
            of which it needs, as "module:object".
        moves_cuda: whether ``.cuda()`` in its code moves to the device of the network instead.
        weights_prefix: before the names of the network in a file of weights.

    Raises:
        InputError: it cannot be imported or built, or `multiple` with `size_hw`.
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
        multiple: Multiple,
        size_hw: Size | None,
        scores: Paths,
        train_scores: Paths | None,
        auxiliary: Path | None,
        resize: bool,
        one_by_one: bool,
        empty_packages: Names,
        stubs: dict[str, dict[str, Text]],
        moves_cuda: bool,
        weights_prefix: Annotated[str, Len(0, 4096)],
    ) -> None:
        super().__init__()
        if size_hw is not None and multiple > 1:
            raise InputError(
                f"model.multiple={multiple} has no effect with model.size_hw; set it to 1."
            )
        self.num_classes = num_classes
        self.record = self.record_from(
            feed=feed, auxiliary=auxiliary, weights_prefix=weights_prefix
        )
        self.source = Checkout.at(checkout, root, empty_packages, stubs)
        self.constructor = constructor
        self.feed, self.multiple, self.size_hw = feed, multiple, size_hw
        self.scores, self.train_scores = scores, train_scores or scores
        self.auxiliary = auxiliary
        self.resize, self.one_by_one, self.moves_cuda = resize, one_by_one, moves_cuda
        self.inputs = inputs
        wanted = arguments | {key: namespace(each) for key, each in namespaces.items()}
        self.network = Builder(self.source, constructor, moves_cuda).build(wanted)

    @staticmethod
    def record_from(
        *, feed: Feed, auxiliary: Path | None, weights_prefix: str, **_: object
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
            InputError: the network refuses images of this size, or returns something else.
        """
        only_view(views, self.record.views, self.constructor)
        images = self.inputs(rgb, thermal, masks, multiple=self.multiple)
        if self.size_hw is not None:
            images = Images(*(_resized(each, self.size_hw) for each in images))
        hw = images.rgb.shape[2], images.rgb.shape[3]
        edges = images.rgb[:, 0]
        if self.feed == "pair_and_edges":
            edges = self._edges(rgb, thermal, hw)
        seed = EVALUATION_SEED
        if self.training:
            if generator is None:
                raise ValueError("training an external network requires `generator`, got None.")
            drawn = torch.randint(2**31, (), generator=generator, device=generator.device)
            seed = int(drawn) ^ rank()
        with seeded(seed, rgb.device):
            called = self._called(images, edges)
        logits, *auxiliary = (self._at_input(each, hw, rgb.shape[2:]) for each in called)
        return Output(logits, {"aux_logits": auxiliary[0]} if auxiliary else {})

    def _edges(self, rgb: Tensor, thermal: Tensor, hw: tuple[int, int]) -> Tensor:
        """The edge map at the size of the prepared images."""
        edges = edge_map(rgb, thermal)[:, None]
        if self.size_hw is not None:
            return _resized(edges, self.size_hw)[:, 0]
        rows, columns = hw[0] - rgb.shape[2], hw[1] - rgb.shape[3]
        return F.pad(edges, (0, columns, 0, rows))[:, 0]

    def _called(self, images: Images, edges: Tensor) -> tuple[Tensor, ...]:
        """Scores, and in training auxiliary ones, at the size that the network gives them."""
        size = 1 if self.one_by_one else len(edges)
        parts = []
        for start in range(0, len(edges), size):
            part = slice(start, start + size)
            arguments = FEEDS[self.feed](Images(*(each[part] for each in images)), edges[part])
            parts.append(self._picked(self._attempt(arguments, images), len(edges[part])))
        return tuple(torch.cat(each) for each in zip(*parts, strict=True))

    def _picked(self, output: Any, count: int) -> tuple[Tensor, ...]:
        """The scores, and in training the auxiliary ones, in an output for `count` images."""
        shape = count, self.num_classes
        name = "train_scores" if self.training else "scores"
        found = [scores_at(output, getattr(self, name), f"model.{name}", shape)]
        if self.training and self.auxiliary is not None:
            found.append(scores_at(output, (self.auxiliary,), "model.auxiliary", shape))
        return tuple(found)

    def _attempt(self, arguments: tuple[Any, ...], images: Images) -> Any:
        """What the author's network returns; its errors in one sentence."""
        try:
            with cuda_calls_to(images.rgb.device if self.moves_cuda else None):
                return self.network(*arguments)
        except (torch.OutOfMemoryError, RunError, KeyboardInterrupt):
            raise
        except BaseException as error:  # SystemExit would end the command without a word
            height, width = images.rgb.shape[2:]
            self._check_not_importing(error)
            place = line_of(error, self.source.folder)
            raise InputError(
                f"model.constructor={self.constructor}: the network cannot predict "
                f"{len(images.rgb)} images of {height} x {width} pixels with "
                f"model.feed={self.feed}: "
                f"{reason(error)}{place}.{advice(error)}"
            ) from error

    def _check_not_importing(self, error: BaseException) -> None:
        """Refuse an import inside `forward` of what the checkout has."""
        if isinstance(error, ImportError) and str(error.name).split(".")[0] in self.source.names:
            raise InputError(
                f"model.constructor={self.constructor}: the network imports '{error.name}' of its "
                f"checkout while it is called{line_of(error, self.source.folder)}; move the import "
                "to the top of that module."
            ) from error

    def _at_input(
        self, scores: Tensor, called_hw: tuple[int, int], image_hw: Sequence[int]
    ) -> Tensor:
        """Scores at the size of the images, as float32."""
        scores = scores.float()
        hw = scores.shape[2], scores.shape[3]
        if hw != called_hw and not self.resize:
            raise InputError(
                f"model.scores: the network returns scores of {hw[0]} x {hw[1]} for images of "
                f"{called_hw[0]} x {called_hw[1]} pixels; set model.resize=true to enlarge them, "
                "or model.multiple if its output is rounded."
            )
        if self.size_hw is not None:
            return _resized(scores, image_hw)
        scores = scores if hw == called_hw else _resized(scores, called_hw)
        return scores[..., : image_hw[0], : image_hw[1]]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> ExternalNetwork:  # noqa: FBT001, FBT002 - as in torch
        """Move the parameters; with `moves_cuda` also plain tensors that modules hold."""
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        for module in self.network.modules() if self.moves_cuda else ():
            plain = {key: each for key, each in vars(module).items() if isinstance(each, Tensor)}
            vars(module).update({key: fn(each) for key, each in plain.items()})
        return self


def _resized(maps: Tensor, hw: Sequence[int]) -> Tensor:
    """(N, C, H, W) at another size, bilinear."""
    return F.interpolate(maps, size=tuple(hw), mode="bilinear", align_corners=False)
