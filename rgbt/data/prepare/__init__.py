"""From a download to what the readers read: ``python -m rgbt.data.prepare``."""
