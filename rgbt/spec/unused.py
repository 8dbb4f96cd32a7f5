"""Report typed settings that the other settings of a run leave without effect."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from omegaconf import DictConfig, OmegaConf

from rgbt.spec.run_spec import NODES

OF_CODE = ("recipe.dataset",)
"""Settings of a recipe that no other setting refers to: code reads them."""


def unused_sentences(config: DictConfig, overrides: Sequence[str]) -> Iterator[str]:
    """One sentence for every typed setting without effect.

    The run is valid, and a grid or a search may type a setting that only some of its points use,
    so this is no error.

    Args:
        config: as composed, with its references to other settings.
        overrides: as typed.
    """
    for word in overrides:
        key = word.lstrip("+").partition("=")[0]
        node, _, setting = key.partition(".")
        needed = NODES[node].used_with.get(setting) if node in NODES else None
        if needed is not None and config[node][needed[0]] != needed[1]:
            found = config[node][needed[0]]
            yield (
                f"{word} has no effect with {node}.{needed[0]}={found}; set "
                f"{node}.{needed[0]}={needed[1]}, or omit it."
            )
        elif node == "recipe" and setting and not _is_read(config, key):
            yield (
                f"{word} has no effect at scale={config.scale.name}, which does not read {key}; "
                "set a value of the scale, such as scale.lr=..., or omit it."
            )


def _is_read(config: DictConfig, key: str) -> bool:
    """Whether code or another setting reads a setting of the recipe."""
    return key in OF_CODE or f"{{{key}}}" in str(OmegaConf.to_container(config))
