"""Imported first by the fork server of ``rgbt``: sets the same search path for user modules."""

from rgbt.config.shadowing import search_user_folders_last

search_user_folders_last()
