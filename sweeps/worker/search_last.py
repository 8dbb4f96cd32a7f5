"""Imported first by the fork server of the command ``rgbt``: searches user modules as that does."""

from rgbt.config.shadowing import search_user_folders_last

search_user_folders_last()
