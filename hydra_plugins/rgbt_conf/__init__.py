"""The Hydra plugin that reads rgbt's configuration files: ``rgbt://FOLDER`` on the search path.

Hydra imports it at every start of every Hydra program of the environment, so it imports nothing
until a file of rgbt is read. Programs that do not use rgbt's own ``conf`` are left as they are.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.core.object_type import ObjectType
from hydra.plugins.config_source import ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin

if TYPE_CHECKING:
    from hydra.core.config_search_path import ConfigSearchPath
    from hydra.plugins.config_source import ConfigResult

SCHEME = "rgbt"


class RgbtConfigSource(ConfigSource):
    """Reads a folder whose files may hold several choices, each file once (`config.compose`)."""

    @staticmethod
    def scheme() -> str:
        """Return the beginning of its paths."""
        return SCHEME

    def load_config(self, config_path: str) -> ConfigResult:
        """Return the values of a choice such as "model/cmx_b0"."""
        from rgbt.config.compose import parsed

        return parsed(self.path, self.provider, config_path)

    def is_config(self, config_path: str) -> bool:
        """Whether there is this choice."""
        from rgbt.config.compose import place_of

        return place_of(self.path, config_path) is not None

    def is_group(self, config_path: str) -> bool:
        """Whether there is a folder of this name."""
        return Path(self.path, config_path).is_dir()

    def available(self) -> bool:
        """Whether the folder exists."""
        return self.is_group("")

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        """Return the names of the groups and choices in a group, sorted."""
        from rgbt.config.compose import choices_in

        folder = Path(self.path, config_path)
        found = set() if results_filter == ObjectType.GROUP else choices_in(folder)
        if results_filter != ObjectType.CONFIG:
            groups = [path.name for path in folder.iterdir() if path.is_dir()]
            found |= set(groups) - {"__pycache__"}
        return sorted(found)


class RgbtSearchPath(SearchPathPlugin):
    """Reads rgbt's ``conf``, and after it the folders of RGBT_CONF, with `RgbtConfigSource`."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Change the search path of a program whose own folder is rgbt's ``conf``."""
        compose = sys.modules.get("rgbt.config.compose")
        if compose is None:  # without its resolvers nobody can compose rgbt's files
            return
        elements = search_path.get_path()
        for main in [
            element for element in elements if element.provider == "main" and element.path
        ]:
            path = main.path.removeprefix("file://")
            if Path(path).resolve() != compose.conf_dir().resolve():
                continue
            main.path = f"{SCHEME}://{path}"
            for folder in compose.own_paths():
                scheme, _, place = folder.rpartition("://")
                own = scheme in ("", "file")
                search_path.append(compose.OWN_FOLDERS, f"{SCHEME}://{place}" if own else folder)
