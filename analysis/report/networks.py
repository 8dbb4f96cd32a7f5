"""The networks of the project with their sizes, for the page of networks."""

from __future__ import annotations

from dataclasses import dataclass

from analysis.report.results_file import Network, load_results_file
from analysis.report.tables import Track
from sweeps.table.efficiency import million_parameters


@dataclass(frozen=True)
class NetworkEntry:
    """A network, and millions of parameters of each of its `Network.models`."""

    network: Network
    millions: tuple[float, ...]


def network_entries(track: Track) -> tuple[NetworkEntry, ...]:
    """All networks of `results.yaml`; each is built without memory to count its parameters."""
    networks = load_results_file().networks
    sizes = [(network, model) for network in networks for model in network.models]
    millions: dict[str, list[float]] = {network.name: [] for network in networks}
    for network, model in track(sizes, "networks"):
        overrides = [*network.overrides, *f"model={model}".split()]
        millions[network.name].append(million_parameters(overrides))
    return tuple(NetworkEntry(each, tuple(millions[each.name])) for each in networks)
