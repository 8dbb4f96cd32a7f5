"""What all evaluations of a network share: its view, its heads, and the images decoded ahead."""

from __future__ import annotations

from contextlib import ExitStack

from rich.progress import Progress, TaskID

from rgbt.build.session import Session
from rgbt.checks import InputError, check_choice
from rgbt.data.cache.dataset import cached_layer
from rgbt.data.domains import TestedHead
from rgbt.engine.evaluate import HeadsOf
from rgbt.engine.progress import progress
from rgbt.requirements import record_of
from rgbt.types import View


def view_of(session: Session, view: View | None = None) -> View:
    """What the network of a session predicts from.

    Args:
        session: see `rgbt.build.session.open_session`.
        view: None: what its source domain is seen as; where that does not say, its first view.

    Raises:
        InputError: the network does not predict from `view`.
    """
    known = record_of(session.model).views
    if view is None:
        return session.domains.source.view or known[0]
    check_choice("modality", view, known)
    return view


def heads_of(session: Session, view: View, head: TestedHead | None = None) -> HeadsOf:
    """Which head predicts an image: that of its domain, or the requested one.

    Args:
        session: see `rgbt.build.session.open_session`.
        view: what is predicted from.
        head: None: as the run's configuration says (`domains.tested_head`).
    """
    requested = session.domains.tested_head if head is None else head

    def choose(names: tuple[str, ...]) -> tuple[str | None, ...]:
        by_night = requested == "own" and session.domains.target_is == "night"
        dark = (_nights(session, names) if by_night else None) or (None,) * len(names)
        return tuple(session.domains.head_of(view, night, requested) for night in dark)

    return choose


def _nights(session: Session, names: tuple[str, ...]) -> tuple[bool, ...] | None:
    """Which images were taken at night; None where that is not known, as of files of one's own."""
    try:
        return session.dataset.nights(names)
    except InputError:
        return None


def decode_ahead(session: Session, *splits: str) -> None:
    """Fill the image cache with these splits, if the session has one.

    In the main process, before others read from it.

    Raises:
        InputError: the cache cannot be written.
    """
    dataset = cached_layer(session.dataset)
    if dataset is None:
        return
    names = tuple(name for split in splits for name in dataset.names(split))
    with ExitStack() as shown:
        tasks: dict[str, TaskID] = {}
        display: list[Progress] = []

        def advance(what: str, done: int, total: int) -> None:
            if not display:  # where everything is there, nothing is shown
                display.append(shown.enter_context(progress()))
            if what not in tasks:
                tasks[what] = display[0].add_task(what, total=total, note="images")
            display[0].update(tasks[what], completed=done)

        dataset.ensure(names, advance)
