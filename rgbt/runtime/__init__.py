"""Handle signals, full disks and exhausted memory."""
